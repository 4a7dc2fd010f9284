"""What the tests of training share; importing it skips them where the extra [train] is not installed."""

import csv
from pathlib import Path

import pytest
from needs import needs

for extra in ("sb3_contrib", "tqdm", "tensorboard", "cma"):
    pytest.importorskip(extra, reason=needs("extras", extra))


class KilledError(Exception):
    """Stands for what ends a process in the middle of training."""


def columns(file: Path, *names: str) -> list[tuple[float, ...]]:
    with file.open(newline="", encoding="utf-8") as lines:
        return [tuple(float(row[name]) for name in names) for row in csv.DictReader(lines)]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Import it where runs are made."""
    monkeypatch.chdir(tmp_path)

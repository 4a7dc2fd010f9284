"""What the tests of training share; importing it skips them where the extra [train] is not installed."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

for extra in ("sb3_contrib", "tqdm", "tensorboard", "cma"):
    pytest.importorskip(extra, reason="the extra [train] is not installed")


class KilledError(Exception):
    """Stands for what ends a process in the middle of training."""


def columns(file: Path, *names: str) -> list[tuple[float, ...]]:
    """These columns of a run's table, row by row."""
    with file.open(newline="", encoding="utf-8") as lines:
        return [tuple(float(row[name]) for name in names) for row in csv.DictReader(lines)]

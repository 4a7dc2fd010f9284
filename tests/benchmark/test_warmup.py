"""``bufgym warmup``: every part of it runs, and it says where the code is kept."""

from __future__ import annotations

import pytest

from bufgym.benchmark.warmup import PARTS
from bufgym.cli import main
from bufgym.kernel import FOLDER, JIT


@pytest.mark.skipif(not JIT, reason="nothing is compiled")
def test_each_part_is_named_and_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["warmup"]) == 0
    told = capsys.readouterr()
    text = told.out + told.err
    assert all(f"{k}/{len(PARTS)} {name}" in text for k, name in enumerate(PARTS, 1))
    assert FOLDER in text

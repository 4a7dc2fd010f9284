"""What the tests of the benchmark share."""

import os
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

import pytest

from bufgym.benchmark.bootstrap import Interval
from bufgym.benchmark.sweep import Sweep

THREE = ("afr", "random", "drop-oldest")
TINY = Sweep("interruption-v1", THREE, capacities=(2, 4), seeds=3)


def bufgym(*words: object, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "bufgym", *map(str, words)],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def ended(*words: object, **environment: str) -> tuple[int, str, str]:
    """Its exit code, and what it said on stdout and stderr."""
    process = bufgym(*words, **environment)
    out, err = process.communicate()
    return process.returncode, out, err


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def interrupt(*_: object) -> NoReturn:
    """Ctrl-C in the middle of what it takes the place of."""
    raise KeyboardInterrupt


def exactly(x: float) -> Interval:
    """Of a statistic that every episode agrees on."""
    return Interval(pytest.approx(x), pytest.approx(x), pytest.approx(x))

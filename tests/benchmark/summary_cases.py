"""What the tests of the benchmark share."""

from __future__ import annotations

import pytest

from bufgym.benchmark.bootstrap import Interval


def exactly(x: float) -> Interval:
    """Of a statistic that every episode agrees on."""
    return Interval(pytest.approx(x), pytest.approx(x), pytest.approx(x))

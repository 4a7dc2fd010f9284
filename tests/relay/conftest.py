"""Mutations lie beside the fuzzing of files; what a relay compiles, it compiles before any test waits for it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "fuzz"))


@pytest.fixture(scope="session", autouse=True)
def _compiled() -> None:
    from relay_cases import settings

    from bufgym.relay import policies

    for name in settings().policies:
        policies.warm(name)

"""A small suite and a policy file, for the tests of sweeps and their folders."""

from pathlib import Path

import pytest
from sweep_cases import THREE

from bufgym.benchmark.sweep import Sweep
from bufgym.scenario import Uplink, suites
from bufgym.traces import Trace


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Sweep:
    def build(split: str, data: Path | None) -> dict[str, suites.Setting]:
        steps = [(1.0, 500_000), (2.0, 0), (1.0, 300_000)]
        traces = tuple(Trace.steps(steps, name=f"{split}-{k}").scaled(1 + k / 2) for k in range(2))
        uplink = Uplink(traces=traces, rate_hz=5, duration_s=5, size_bytes=100_000)
        return {label: suites.Setting(uplink, f"{label} here", outage_s=2.0) for label in ("one", "two")}

    monkeypatch.setitem(suites.SUITES, "small-v1", suites.Suite("small-v1", "small", build, (2, 3), 2))
    return Sweep("small-v1", THREE)


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A policy file: ``mine`` may fail, as the environment says."""
    path = tmp_path / "mine.py"
    path.write_text(
        "import os\n"
        "from bufgym.policies import ACCEPT, REJECT, register\n"
        "@register('mine', memory={'seen': 0})\n"
        "def mine(buffer, arrival, memory):\n"
        "    'Every other one.'\n"
        "    memory[0] += 1\n"
        "    if os.environ.get('TEST_FAIL') and len(buffer.slots) == 2:\n"
        "        raise ArithmeticError('on purpose')\n"
        "    return ACCEPT if memory[0] % 2 and len(buffer.slots) < buffer.capacity else REJECT\n"
    )
    return path

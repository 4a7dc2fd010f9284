"""Whatever comes in, it ends in a result or in one line: files of every kind, command lines, random episodes.

Each batch of inputs has a process of its own, with 2 GB of memory and 10 s an input. `make fuzz` has 100,000 files of
each kind, 10,000 command lines and 1,000,000 episodes; every day there are a few.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from inputs import KINDS
from mutations import COUNT, SEED

from bufgym import policies
from bufgym.model import qoi
from bufgym.scenario import Streams, Uplink
from bufgym.sim.metrics import outcome
from bufgym.sim.senders import run
from bufgym.traces import Trace

HERE = Path(__file__).parent
BATCHES = max(1, COUNT // 10_000)
EPISODES = 16
"""Of one scenario, which all policies meet."""


def ended_well(program: str, *arguments: str) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_DISABLE_JIT": "0", "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, str(HERE / program), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=environment)
    assert done.returncode == 0, f"{' '.join(arguments)}: code {done.returncode}: {done.stderr[-3000:]}"


def batch(k: int, count: int) -> tuple[str, str]:
    return str(k * count // BATCHES), str((k + 1) * count // BATCHES)


@pytest.mark.parametrize("k", range(BATCHES))
@pytest.mark.parametrize("kind", KINDS)
def test_broken_files(kind: str, k: int) -> None:
    pytest.importorskip("resource")
    ended_well("inputs.py", kind, *batch(k, max(50, COUNT // (1 if BATCHES > 1 else 4))))


@pytest.mark.parametrize("k", range(BATCHES))
def test_command_lines(k: int) -> None:
    pytest.importorskip("resource")
    ended_well("commands.py", *batch(k, max(50, COUNT // (10 if BATCHES > 1 else 4))))


def scenario(uniform: random.Random) -> Uplink:
    steps = [
        (uniform.choice([0.01, 0.3, 2]), uniform.choice([0, 0, 1, 3e3, 1e5])) for _ in range(uniform.randint(1, 5))
    ]
    link = Trace.steps([*steps, (0.2, 5e3)], after=uniform.choice(["loop", "hold"]))
    return Uplink(
        traces=(link,),
        rate_hz=uniform.choice([5, 30, 1000]),
        duration_s=uniform.choice([0.2, 0.5, 1.0]),
        jitter=uniform.choice([0, 0.1, 1]),
        size_bytes=uniform.choice([1, 40, 1000, 10**6]),
        size_cv=uniform.choice([0, 0.5, 3]),
        value=uniform.choice([qoi.exponential(), qoi.exponential(0.01), qoi.saturating(7)]),
    )


@pytest.mark.parametrize("k", range(BATCHES))
def test_random_episodes_keep_the_invariants(k: int) -> None:
    """Each message ends somewhere, once; no more than L wait; deliveries come in order; H is within its bounds."""
    first, last = map(int, batch(k, max(160, COUNT * 10 if BATCHES > 1 else 0)))
    for number in range(first // EPISODES, -(-last // EPISODES)):
        uniform = random.Random(f"{SEED}-episode-{number}")
        met = scenario(uniform)
        capacity = uniform.choice([1, 2, 3, 8, 40])
        policy = policies.get(
            uniform.choice([name for name in policies.names(for_topics=False) if name != "clairvoyant"])
        )
        limit = uniform.choice([None, None, 2 * 10**6])
        episodes = []
        for i in range(EPISODES):
            streams = Streams.seeded(number * EPISODES + i)
            episodes.append(met.draw(streams).with_uniforms(streams.policy))
        senders = run(policy, episodes, capacity, met.value, max_bytes=limit)
        for i in range(EPISODES):
            case = f"{policy.name}, L = {capacity}, seed {SEED}, scenario {number}, episode {i}"
            end = outcome(senders, i)
            assert end.arrived == end.delivered + end.dropped + end.in_transmission + end.buffered, case
            assert end.buffered <= capacity or not policy.ranked, case
            assert 0 <= end.qoi <= max(1, end.arrived) + 1e-9 and np.isfinite(end.qoi), case

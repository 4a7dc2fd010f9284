"""``examples/one_file.py``, a sender and its environment in plain Python, against the product on random episodes."""

import importlib.util
import runpy
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from bufgym import policies
from bufgym.envs import SenderEnv
from bufgym.model import Link, qoi
from bufgym.scenario import Episode, Interruption, messages
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.sim.state import NEVER
from bufgym.traces import Trace

PATH = Path(__file__).resolve().parents[2] / "examples" / "one_file.py"
VALUES = qoi.exponential(0.8), qoi.saturating(2.5), qoi.tabulated([0, 1, 4], [0, 0.5, 1])
EPISODES = range(200)


@pytest.fixture(scope="module")
def one_file() -> ModuleType:
    spec = importlib.util.spec_from_file_location("one_file", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def drawn(seed: int) -> tuple[Episode, int, qoi.Value]:
    """An episode, L and V: outages, messages at the same time, equal and unequal sizes, x at a standstill."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 150))
    step_us = rng.choice([0, 1, 20_000, 33_333], n) + rng.integers(0, 30_000, n) * (seed % 2)
    size_bytes = rng.integers(1, 60_000, n) if seed % 3 else np.full(n, 30_000)
    x = np.cumsum(rng.choice([0.0, 0.25, 1.0], n) if seed % 5 else rng.random(n))
    pieces = int(rng.integers(1, 8))
    us = np.cumsum([0, *rng.integers(1_000, 900_000, pieces)])
    carried = np.cumsum([0, *rng.choice([0, 300, 40_000, 400_000], pieces - 1), rng.integers(20_000, 500_000)])
    link = Link(Trace("drawn", us, carried, after="loop"), int(rng.integers(0, 3 * us[-1])))
    return Episode(messages(np.cumsum(step_us), size_bytes, x), link), int(rng.integers(1, 12)), VALUES[seed % 3]


def sender(one_file: ModuleType, seed: int) -> Any:
    """The same episode as a sender of the one file."""
    episode, capacity, v = drawn(seed)
    trace, fields = episode.link.trace, ("seq", "arrival_us", "size_bytes", "x")
    listed = [one_file.Message(*(message[name].item() for name in fields)) for message in np.asarray(episode.arrivals)]
    link = one_file.Link(trace.time_us.tolist(), trace.cumulative_bytes.tolist(), episode.link.offset_us)
    return one_file.Sender(listed, link, capacity, v)


def test_it_is_short_and_stands_alone() -> None:
    text = PATH.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 200
    assert not [line for line in text.splitlines() if "import" in line and "bufgym" in line]


def test_afr_drops_the_same_messages(one_file: ModuleType) -> None:
    dropped = 0
    for seed in EPISODES:
        episode, capacity, v = drawn(seed)
        senders = run(policies.get("afr"), [episode], capacity, v)
        plain = sender(one_file, seed)
        H = one_file.AFR().play(plain)
        log = senders.batch.log[0]
        assert sorted(m.seq for m in plain.dropped) == np.flatnonzero(log["dropped_us"] != NEVER).tolist(), seed
        assert H == pytest.approx(outcome(senders, 0).qoi, abs=1e-9), seed
        dropped += len(plain.dropped)
    assert dropped > 2000  # so most episodes overflow, and the comparison means something


def test_every_step_of_the_environment_is_the_same(one_file: ModuleType) -> None:
    steps, drops = 0, [0, 0, 0]
    for seed in EPISODES:
        episode, capacity, v = drawn(seed)
        env = SenderEnv(Interruption(value=v), capacity, reward="retained")
        plain = one_file.QueueEnv(lambda rng, seed=seed: sender(one_file, seed))
        (seen, info), (plain_seen, plain_info) = env.reset(options={"episode": episode}), plain.reset(seed=seed)
        rng, ended, total = np.random.default_rng(seed), False, 1.0
        while not ended:
            assert plain_info["slots"].tolist() == info["slots"].tolist(), (seed, steps)
            np.testing.assert_allclose(plain_seen, seen, rtol=0, atol=1e-6, err_msg=f"{seed}, {steps}")
            action = int(rng.integers(3))
            drops[action] += 1
            seen, reward, ended, _, info = env.step(action)
            plain_seen, plain_reward, plain_ended, _, plain_info = plain.step(action)
            assert (plain_reward, plain_ended) == (pytest.approx(reward, abs=1e-9), ended), (seed, steps)
            total += plain_reward
            steps += 1
        assert total == pytest.approx(info["qoi"], abs=1e-9), seed
    assert steps > 2000 and min(drops) > 500


def test_it_runs(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(PATH), run_name="__main__")
    assert [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()] == ["AFR", "random actions"]

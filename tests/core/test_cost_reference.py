"""The rewards ``cost`` and ``paired`` on random episodes, against a model that asks what was dropped, nothing else."""

import itertools
from typing import Any

import naive
import numpy as np
import pytest
from cases import ANYTHING, Case, cases
from hypothesis import given
from hypothesis import strategies as st

from bufgym.envs import SenderEnv
from bufgym.model import qoi
from bufgym.scenario import Interruption
from bufgym.sim import run
from bufgym.sim.metrics import outcome

kernels = pytest.mark.kernels
HALF = qoi.exponential(0.5)


def gaps(v: Any, x: Any) -> float:
    """The sum of V over the steps of x, one after another."""
    return float(sum(v(b - a) for a, b in itertools.pairwise(x)))


def stands(v: Any, x: Any, kept: Any) -> float:
    """Sum of V between messages kept, and from the last of them to the newest, less that of all; x of the arrivals."""
    last = v(x[-1] - x[kept][-1]) if len(x) and kept.any() else 0.0
    return gaps(v, x[kept]) + last - gaps(v, x)


def chosen(mask: Any, rng: np.random.Generator) -> int:
    """A valid action, at random."""
    return int(rng.choice(np.flatnonzero(mask)))


@kernels
@given(cases(max_messages=25), st.integers(0, 2**32), st.sampled_from(["slots", "candidates"]))
def test_every_step_is_that_of_the_model(case: Case, seed: int, actions: str) -> None:
    """Which of the arrivals so far are dropped says it all, so a robot can tell: neither link nor future is in it."""
    v, rng = naive.exponential(0.5), np.random.default_rng(seed)
    limits: dict[str, Any] = {"max_bytes": case.max_bytes, "decide_at": case.decide_at, "actions": actions}
    env = SenderEnv(Interruption(t_max=40, value=HALF), case.capacity, reward="cost", **limits)
    _, info = env.reset(options={"episode": case.episode})
    batch, x, before, ended, total = env.sub_envs.senders.batch, case.episode.arrivals["x"], 0.0, False, 0.0
    while not ended:
        _, reward, ended, _, info = env.step(chosen(info["action_mask"], rng))
        arrived = int(batch.senders[0]["next"])
        total += reward
        if not ended:
            now = stands(v, np.asarray(x[:arrived]), np.asarray(batch.log)[0, :arrived]["dropped_us"] < 0)
            assert reward == pytest.approx(now - before, abs=1e-9)
            before = now
    assert total == pytest.approx(max(info["qoi"], 1.0) - 1 - gaps(v, np.asarray(x)), abs=1e-9)


@kernels
@given(cases(max_messages=25), st.integers(0, 2**32))
def test_a_rule_of_any_kind_decides_in_the_shadow_as_it_does_in_a_run(case: Case, seed: int) -> None:
    """Random decisions of the policy, invalid ones among them, against random actions, on links of all kinds."""
    limits = {"max_bytes": case.max_bytes, "decide_at": case.decide_at}
    scenario = Interruption(t_max=40, value=HALF)
    env = SenderEnv(scenario, case.capacity, reward="paired", reference=ANYTHING, **limits)
    rng, (_, info), ended, total = np.random.default_rng(seed), env.reset(options={"episode": case.episode}), False, 0.0
    while not ended:
        _, reward, ended, _, info = env.step(chosen(info["action_mask"], rng))
        total += reward
    of_rule = outcome(run(ANYTHING, [case.episode], case.capacity, HALF, max_bytes=case.max_bytes), 0).qoi
    assert total == pytest.approx(max(info["qoi"], 1.0) - max(of_rule, 1.0), abs=1e-9)

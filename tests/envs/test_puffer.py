"""PufferLib's native environment: the rows of the batch, written into the caller's own arrays."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("pufferlib", reason="pufferlib is not installed")

import pufferlib.vector

from bufgym.envs import SenderVectorEnv
from bufgym.envs.puffer import PufferSenders
from bufgym.ground.errors import BufgymError
from bufgym.scenario import Interruption

N, L = 3, 4
SHORT = Interruption(t_max=12)


@pytest.mark.parametrize("fields", [None, ["rank", "loss", "busy"]])
def test_equal_to_the_batch(fields: Any) -> None:
    puffer = PufferSenders(N, SHORT, L, seed=5, fields=fields)
    batch = SenderVectorEnv(N, SHORT, L, observation="flat", fields=fields, autoreset_mode="SameStep")
    observed, _ = puffer.reset()
    expected, _ = batch.reset(seed=5)
    assert (observed == expected).all() and observed is puffer.observations
    rng = np.random.default_rng(1)
    ends = 0
    for _ in range(80):
        actions = rng.integers(0, L + 2, N)
        *results, infos = puffer.step(actions.astype(np.int32))
        *expecteds, info = batch.step(actions)
        assert (puffer.action_masks() == batch.action_masks()).all()
        for result, column in zip(results, expecteds, strict=True):
            assert np.allclose(result, column, atol=1e-6)
        ended = np.flatnonzero(expecteds[2])
        assert [told["qoi"] for told in infos] == [info["final_info"]["qoi"][i] for i in ended]
        ends += len(ended)
    assert ends > N


def test_all_fields_are_written_straight_into_the_callers_array() -> None:
    puffer = PufferSenders(N, SHORT, L)
    assert puffer.rows.output.flat is puffer.observations
    assert PufferSenders(N, SHORT, L, fields=["rank"]).rows.output.flat is not puffer.observations


def test_pufferlibs_own_vector_takes_it() -> None:
    """Two of them over one array, which PufferLib divides among them."""
    envs = pufferlib.vector.make(
        PufferSenders,
        num_envs=2,
        env_kwargs={"num_envs": N, "scenario": SHORT, "capacity": L},
        backend=pufferlib.vector.Serial,
    )
    observed, _ = envs.reset(seed=3)
    assert observed.shape == (2 * N, envs.single_observation_space.shape[0])
    first = observed.copy()
    for _ in range(20):
        observed, *_ = envs.step(np.full(2 * N, L + 1))
    assert np.isfinite(observed).all() and (observed != first).any()
    for env in envs.envs:
        assert np.shares_memory(env.rows.output.flat, envs.observations)
    envs.close()


def test_what_it_refuses() -> None:
    with pytest.raises(BufgymError, match="observation = 'dict': must be 'flat' for PufferLib"):
        PufferSenders(N, SHORT, L, observation="dict")
    puffer = PufferSenders(N, SHORT, L)
    puffer.reset(seed=1)
    with pytest.raises(BufgymError, match=r"actions\[1\] = 6: must lie in 0..5"):
        puffer.step(np.array([0, 6, 0]))
    with pytest.raises(BufgymError, match=r"actions have shape \(2,\)"):
        puffer.step(np.array([0, 1]))

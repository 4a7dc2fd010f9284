"""How large returns are with ``reward_scale``, and how long an episode can be."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import SMALL, client
from gymnasium.wrappers import TimeAwareObservation
from refusal_cases import refused

import bufgym
from bufgym.envs import FleetVecEnv, SenderEnv, SenderVectorEnv
from bufgym.envs.expert import policy
from bufgym.model.observe import reward_term
from bufgym.scenario import Interruption


@pytest.fixture(autouse=True)
def half() -> None:
    reward_term("half_of_a_point", unit="1")(lambda step, memory: 0.5)


def played(envs: Any, rule: str = "afr") -> list[Any]:
    """Rewards and terms of a rule, step by step, until the first row ends."""
    envs.reset(seed=1)
    player, steps, over = policy(envs, rule), [], False
    while not over:
        _, rewards, terminated, _, info = envs.step(player.actions())
        over = bool(np.any(terminated))
        steps.append((rewards, info["reward_terms"]))
    return steps


@pytest.mark.parametrize("id", bufgym.ENVIRONMENTS)
def test_a_scale_multiplies_the_reward_and_nothing_else(id: str) -> None:
    plain = played(gym.make_vec(id, 2, **SMALL[id]))
    for scale in (0.25, "episode"):
        envs = gym.make_vec(id, 2, reward_scale=scale, **SMALL[id])
        factor = scale if scale != "episode" else envs.unwrapped.sub_envs.scenario.reward_scale
        for (before, terms), (rewards, same_terms) in zip(plain, played(envs), strict=True):
            np.testing.assert_allclose(rewards, factor * before, rtol=1e-12)
            assert str(terms) == str(same_terms)


def test_a_fleet_has_the_scale_of_its_uplink() -> None:
    options: dict[str, Any] = {"cells": 1, "robots": 2, "duration_s": 1.0}
    plain, scaled = (played(FleetVecEnv(reward_scale=scale, **options)) for scale in (None, "episode"))
    np.testing.assert_allclose([step[0] for step in scaled], [0.1 * step[0] for step in plain], rtol=1e-12)


def test_weights_of_your_own_terms_are_the_size_that_you_give_them() -> None:
    rewards = {"retained": 1.0, "half_of_a_point": 3.0}
    sub_envs = SenderEnv("lte", reward=rewards, reward_scale="episode", actions="slots").sub_envs
    weights = {
        term.name: weight for term, weight in zip(sub_envs.terms, sub_envs.weights.tolist(), strict=True) if weight
    }
    assert weights == {"retained": 0.1, "half_of_a_point": 3.0}
    sub_envs = SenderEnv("lte", reward=rewards, reward_scale=2, actions="slots").sub_envs
    assert [weight for weight in sub_envs.weights.tolist() if weight] == [2.0, 6.0]


@pytest.mark.parametrize("id", bufgym.ENVIRONMENTS)
def test_a_rules_return_lies_between_1_and_10(id: str) -> None:
    envs = gym.make_vec(id, 20, reward_scale="episode")
    envs.reset(seed=0)
    player, returns, over = policy(envs, "target-gap"), np.zeros(20), np.zeros(20, np.bool_)
    while not over.all():
        _, rewards, terminated, *_ = envs.step(player.actions())
        returns += np.where(over, 0.0, rewards)
        over |= terminated
    assert 1 < returns.mean() < 10


@pytest.mark.parametrize("choice", ["hold", "accept", "oldest", "random"])
@pytest.mark.parametrize(
    "options",
    [
        {"scenario": "lte", "duration_s": 3.0},
        {"scenario": "lte", "duration_s": 3.0, "max_bytes": 500_000, "sizes": "jpeg"},
        {"scenario": client(duration_s=4.0)},
        {"scenario": client(duration_s=4.0, window=3), "max_bytes": 9_000},
    ],
    ids=["lte", "bytes", "topics", "topics-bytes"],
)
def test_no_episode_is_as_long_as_the_spec_says(options: dict[str, Any], choice: str) -> None:
    env: Any = gym.make("bufgym/Uplink-v0", capacity=3, **options, actions="slots")
    _, info = env.reset(seed=0)
    rng, fixed = np.random.default_rng(0), {"hold": 3, "accept": 4, "oldest": 0}
    steps, ended = 0, False
    while not ended:
        action = fixed[choice] if choice in fixed else int(rng.choice(np.flatnonzero(info["action_mask"])))
        _, _, ended, truncated, info = env.step(action)
        steps += 1
        assert not truncated
    assert steps < env.spec.max_episode_steps


def test_the_time_in_the_observation() -> None:
    """T = 4 has 6 messages, of which 1 to 4 ask."""
    plain = gym.make("bufgym/Interruption-v0", law="fixed", t_max=4, actions="slots")
    env: Any = TimeAwareObservation(plain, flatten=False, normalize_time=True)
    assert env.spec.max_episode_steps == 7
    seen, _ = env.reset(seed=0)
    times = [seen["time"].item()]
    for _ in range(4):
        seen, *_ = env.step(9)
        times.append(seen["time"].item())
    assert times == pytest.approx([k / 7 for k in range(5)])


def test_an_episode_that_arguments_lengthen_is_not_cut() -> None:
    spec = gym.make("bufgym/Uplink-v0", duration_s=40.0, actions="slots").spec
    assert spec is not None and spec.max_episode_steps == 40 * 30 + 1
    assert gym.spec("bufgym/Uplink-v0").max_episode_steps is None


class Bare(Interruption):
    reward_scale = None  # type: ignore[assignment]


test_scales_that_make_no_sense = refused(
    (lambda: SenderEnv(reward_scale=0, actions="slots"), r"reward_scale = 0: must be a number > 0, 'episode' or None"),
    (
        lambda: SenderVectorEnv(reward_scale="auto", actions="slots"),
        r"reward_scale = 'auto': must be a number > 0, 'episode' or None",
    ),
    (lambda: FleetVecEnv(reward_scale=float("nan")), "reward_scale = nan"),
    (
        lambda: SenderEnv(Bare(), reward_scale="episode", actions="slots"),
        "this scenario has no `reward_scale`; give a number",
    ),
)

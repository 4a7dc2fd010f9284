"""How a weight scales returns, and how long an episode can be."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import SMALL, client
from gymnasium.wrappers import TimeAwareObservation

from bufgym.envs.expert import policy


def played(envs: Any, rule: str = "afr") -> list[Any]:
    """Rewards and terms of a rule, step by step, until the first row ends."""
    envs.reset(seed=1)
    player, steps, over = policy(envs, rule), [], False
    while not over:
        _, rewards, terminated, _, info = envs.step(player.actions())
        over = bool(np.any(terminated))
        steps.append((rewards, info["reward_terms"]))
    return steps


def test_a_weight_is_a_factor_on_the_reward_and_on_nothing_else() -> None:
    """As ``docs/guide/environments.md`` has it for returns of a size that a learner likes."""
    for id, factor in (("bufgym/Uplink-v1", 0.1), ("bufgym/Topics-v0", 0.0005)):
        plain = played(gym.make_vec(id, 2, reward="retained", **SMALL[id]))
        scaled = played(gym.make_vec(id, 2, reward={"retained": factor}, **SMALL[id]))
        for (before, terms), (rewards, same_terms) in zip(plain, scaled, strict=True):
            np.testing.assert_allclose(rewards, factor * before, rtol=1e-12)
            assert str(terms) == str(same_terms)


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
    env: Any = gym.make("bufgym/Uplink-v1", capacity=3, **options, actions="slots")
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
    plain = gym.make("bufgym/Interruption-v1", law="fixed", t_max=4, actions="slots")
    env: Any = TimeAwareObservation(plain, flatten=False, normalize_time=True)
    assert env.spec.max_episode_steps == 7
    seen, _ = env.reset(seed=0)
    times = [seen["time"].item()]
    for _ in range(4):
        seen, *_ = env.step(9)
        times.append(seen["time"].item())
    assert times == pytest.approx([k / 7 for k in range(5)])


def test_an_episode_that_arguments_lengthen_is_not_cut() -> None:
    spec = gym.make("bufgym/Uplink-v1", duration_s=40.0, actions="slots").spec
    assert spec is not None and spec.max_episode_steps == 40 * 30 + 1
    assert gym.spec("bufgym/Uplink-v1").max_episode_steps is None

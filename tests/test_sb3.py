"""What stable-baselines3 may rely on: its own check of the single environment, and the contract of its VecEnv."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra [train] is not installed")
pytest.importorskip("sb3_contrib", reason="the extra [train] is not installed")

from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import bufgym
from bufgym.errors import BufgymError
from bufgym.sb3 import GymVecEnv, make_vec_env

SMALL: dict[str, dict[str, Any]] = {
    "bufgym/Interruption-v0": {"capacity": 3, "t_max": 20},
    "bufgym/Uplink-v0": {"capacity": 3, "duration_s": 1.0, "size_bytes": 1_000_000},
    "bufgym/Topics-v0": {"capacity": 3, "duration_s": 0.1},
}
L = 3


def some_actions(masks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A possible action in each row, at random."""
    return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])


@pytest.mark.parametrize("id", bufgym.ENVIRONMENTS)
def test_the_checker_of_stable_baselines3_has_nothing_to_say(id: str) -> None:
    check_env(gym.make(id, **SMALL[id]).unwrapped, warn=True)  # a warning is an error here


@pytest.mark.parametrize("id", bufgym.ENVIRONMENTS)
def test_rows_are_single_environments_and_their_ends_are_told(id: str) -> None:
    n, rng = 4, np.random.default_rng(0)
    envs = make_vec_env(id, n, seed=7, **SMALL[id])
    singles = [gym.make(id, **SMALL[id]) for _ in range(n)]
    observation = envs.reset()
    assert isinstance(observation, dict)
    started = [env.reset(seed=7 + i)[0] for i, env in enumerate(singles)]
    sums, lengths, ends = np.zeros(n), np.zeros(n, int), 0
    for key in observation:
        assert np.array_equal(observation[key], [first[key] for first in started])
    for _ in range(60):
        masks = get_action_masks(envs)
        assert np.array_equal(masks, [env.get_wrapper_attr("action_masks")() for env in singles])
        actions = some_actions(masks, rng)
        observation, rewards, dones, infos = envs.step(actions)
        for i, env in enumerate(singles):
            last, reward, terminated, truncated, info = env.step(actions[i])
            sums[i] += float(reward)
            lengths[i] += 1
            assert rewards[i] == np.float32(reward)
            assert dones[i] == (terminated or truncated)
            if dones[i]:
                told = infos[i]
                assert set(told["terminal_observation"]) == set(last)
                assert all(np.array_equal(told["terminal_observation"][key], last[key]) for key in last)
                assert told["TimeLimit.truncated"] is False
                assert told["episode"]["r"] == pytest.approx(sums[i])
                assert told["episode"]["l"] == lengths[i]
                for name in ("qoi", "arrived", "delivered", "dropped", "invalid"):
                    assert told[name] == info[name]
                if id != "bufgym/Topics-v0":  # each topic received adds its weight there
                    assert told["qoi"] == pytest.approx(1 + sums[i])
                sums[i], lengths[i], ends = 0.0, 0, ends + 1
                last, _ = env.reset()
            else:
                assert infos[i] == {}
            assert all(np.array_equal(observation[key][i], last[key]) for key in last)
    assert ends >= n


def test_a_time_limit_truncates() -> None:
    envs = make_vec_env("bufgym/Uplink-v0", 2, seed=0, max_episode_steps=5, **SMALL["bufgym/Uplink-v0"])
    envs.reset()
    for step in range(1, 11):
        _, _, dones, infos = envs.step(np.full(2, L))  # reject everything
        assert dones.tolist() == [step % 5 == 0] * 2
        if dones[0]:
            assert infos[0]["TimeLimit.truncated"] is True
            assert infos[0]["episode"]["l"] == 5
            assert infos[0]["terminal_observation"]["rank"].shape == (L + 1,)


def test_observations_handed_out_stay_as_they_were() -> None:
    envs = make_vec_env("bufgym/Uplink-v0", 3, seed=0, **SMALL["bufgym/Uplink-v0"])
    held = [envs.reset()]
    copies = [{key: array.copy() for key, array in held[0].items()}]  # type: ignore[union-attr]
    for _ in range(40):
        observation = envs.step(np.full(3, L + 1))[0]
        held.append(observation)
        copies.append({key: array.copy() for key, array in observation.items()})  # type: ignore[union-attr]
    for observation, copy in zip(held, copies, strict=True):
        assert all(np.array_equal(observation[key], copy[key]) for key in copy)  # type: ignore[index]


def test_masks_and_attributes() -> None:
    envs = make_vec_env("bufgym/Interruption-v0", 5, **SMALL["bufgym/Interruption-v0"])
    envs.reset()
    assert is_masking_supported(envs)
    masks = get_action_masks(envs)
    assert masks.shape == (5, L + 2)
    assert masks.dtype == np.bool_
    # An empty buffer: nothing to evict, the newcomer may be rejected or accepted.
    assert masks.tolist() == [[False] * L + [True, True]] * 5
    assert len(envs.env_method("action_masks", indices=[1, 3])) == 2
    assert len(envs.get_attr("action_masks")) == 5
    assert envs.get_attr("action_space", 0) == [gym.spaces.Discrete(L + 2)]
    assert envs.get_attr("render_mode") == [None] * 5
    assert not envs.has_attr("no_such_thing")
    envs.set_attr("note", "kept")
    assert envs.get_attr("note", [0, 4]) == ["kept", "kept"]
    with pytest.raises(BufgymError, match="share it"):
        envs.set_attr("note", "lost", indices=[1])
    assert envs.env_is_wrapped(Monitor) == [True] * 5
    assert envs.env_is_wrapped(gym.wrappers.TimeLimit) == [False] * 5
    envs.close()


def test_seeds_and_options_hold_for_one_reset() -> None:
    envs = make_vec_env("bufgym/Interruption-v0", 2, **SMALL["bufgym/Interruption-v0"])
    assert envs.seed(3) == [3, 4]

    def lengths() -> list[int]:
        """Arrivals of the next episode of each row."""
        found = [0, 0]
        envs.reset()
        while not all(found):
            _, _, dones, infos = envs.step(np.full(2, L))
            for i in np.flatnonzero(dones):
                found[i] = found[i] or infos[i]["arrived"]
        return found

    first, second = lengths(), lengths()
    envs.seed(3)
    assert lengths() == first
    assert lengths() == second
    scenario = envs.get_attr("rows")[0].scenario
    envs.set_options({"episodes": [scenario.episode(4), scenario.episode(9)]})
    assert lengths() == [6, 11]  # T and the two messages around the interruption
    with pytest.raises(BufgymError, match="not a list"):
        envs.set_options([{}, {}])


def test_any_vector_environment_that_resets_in_the_same_step_will_do() -> None:
    envs = make_vec_env("CartPole-v1", 3, seed=0)
    assert envs.reset().shape == (3, 4)  # type: ignore[union-attr]
    ended = []
    for _ in range(30):
        _, _, dones, infos = envs.step(np.zeros(3, int))
        ended += [infos[i] for i in np.flatnonzero(dones)]
    assert ended
    for info in ended:
        assert info["terminal_observation"].shape == (4,)
        assert info["episode"]["r"] == info["episode"]["l"]
    assert envs.get_attr("gravity", 1) == [9.8]
    envs.set_attr("gravity", 5.0, indices=[1])
    assert envs.get_attr("gravity") == [9.8, 5.0, 9.8]
    assert envs.env_is_wrapped(gym.wrappers.TimeLimit) == [True] * 3
    assert not is_masking_supported(envs)
    envs.close()
    with pytest.raises(BufgymError, match="SAME_STEP"):
        GymVecEnv(gym.make_vec("bufgym/Uplink-v0", 2))


def test_infos_of_every_step_on_request() -> None:
    native = gym.make_vec("bufgym/Uplink-v0", 2, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
    envs = GymVecEnv(native, step_infos=True)
    envs.reset()
    _, rewards, _, infos = envs.step(np.full(2, 9))
    assert infos[1]["reward_terms"]["retained"] == pytest.approx(rewards[1])
    assert infos[0]["action_mask"].shape == (10,)


def test_maskable_ppo_learns_from_it() -> None:
    envs = make_vec_env("bufgym/Interruption-v0", 8, seed=0, **SMALL["bufgym/Interruption-v0"])
    model = MaskablePPO("MultiInputPolicy", envs, n_steps=64, batch_size=256, n_epochs=1, seed=0, device="cpu")
    model.learn(2_000)
    assert model.num_timesteps == 2_048
    assert model.ep_info_buffer
    mean, _ = evaluate_policy(model, envs, n_eval_episodes=8)
    assert isinstance(mean, float)
    assert 0 <= mean <= 20

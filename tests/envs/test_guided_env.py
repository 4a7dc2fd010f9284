"""Guided environments: zero actions are the rule gap-price, any others are what the same rule does in a rollout."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import DYING, FADING, SMALL, last_info, same
from gymnasium.utils.env_checker import check_env
from refusal_cases import refused

import bufgym
from bufgym import policies
from bufgym.envs import FleetVecEnv, SenderEnv, SenderVectorEnv, expert
from bufgym.model import qoi
from bufgym.policies.guided import INPUTS, OUTPUTS, SCALES, GuidedWeights
from bufgym.scenario import Uplink
from bufgym.sim import run

kernels = pytest.mark.kernels
CASES: dict[str, tuple[Uplink, dict[str, Any]]] = {
    "equal": (Uplink(traces=(FADING,), jitter=0.8, duration_s=2.0, size_bytes=100_000), {}),
    "unequal": (Uplink(traces=(FADING,), jitter=0.5, size_cv=0.7, duration_s=2.0, size_bytes=200_000), {}),
    "bytes": (Uplink(traces=(FADING,), size_cv=0.7, duration_s=1.5), {"max_bytes": 600_000}),
    "dying": (Uplink(traces=(DYING,), duration_s=0.8, value=qoi.saturating(3.0)), {"decide_at": "overflow"}),
}
L, N = 5, 3


def played(case: str, choose: Any, seed: int = 0) -> tuple[SenderEnv, Any]:
    """An episode of the environment, whose actions are chosen by what is observed; the times at which messages go."""
    scenario, options = CASES[case]
    env = SenderEnv(scenario, L, actions="guided", fields="guided", **options)
    assert last_info(env, lambda seen, _: choose(seen), seed=seed)["invalid"] == 0
    return env, env.sub_envs.senders.batch.log["dropped_us"][0]


def rolled(env: SenderEnv, case: str, policy: Any) -> Any:
    """The same of a policy on the environment's episode."""
    scenario, options = CASES[case]
    return run(policy, [env.sub_envs.senders.episodes[0]], L, scenario.value, **options).batch.log["dropped_us"][0]


def zero(seen: Any) -> Any:
    return np.zeros(len(OUTPUTS), np.float32)


@kernels
@pytest.mark.parametrize("case", CASES)
def test_zero_actions_are_gap_price(case: str) -> None:
    env, gone = played(case, zero)
    assert (gone > 0).any() and np.array_equal(gone, rolled(env, case, policies.get("gap-price")))


@kernels
@pytest.mark.parametrize("case", CASES)
def test_who_sees_what_the_rule_sees_may_choose_slots(case: str) -> None:
    """Other fields change no decision: the first valid slot goes, and if there is none the newcomer is accepted."""
    scenario, options = CASES[case]
    gone = []
    for fields in ("guided", None):
        env = SenderEnv(scenario, L, actions="slots", fields=fields, **options)
        last_info(env, lambda _, info: int(np.argmax(info["action_mask"])), seed=0)
        gone.append(env.sub_envs.senders.batch.log["dropped_us"][0].copy())
    assert np.array_equal(*gone) and (gone[0] > 0).any()


@kernels
@pytest.mark.parametrize("case", CASES)
def test_actions_are_the_outputs_of_a_policy_over_their_scales(case: str) -> None:
    """A policy of constant outputs, which keeps the plain rule on a measured steady link."""
    action = np.random.default_rng(1).integers(-2, 3, len(OUTPUTS)).astype(np.float32) / 4
    weights = np.zeros((len(OUTPUTS), len(INPUTS)))
    weights[:, list(INPUTS).index("one")] = action * SCALES
    env, gone = played(case, lambda seen: action * (1 - seen["plain"]))
    assert np.array_equal(gone, rolled(env, case, GuidedWeights(weights).policy("constant")))


def test_memory_begins_anew_with_the_episode() -> None:
    scenario, _ = CASES["unequal"]
    used, fresh = (SenderEnv(scenario, L, actions="guided", fields="guided") for _ in range(2))
    used.reset(seed=1)
    for _ in range(20):
        used.step(zero(None))
    episode = scenario.draw(bufgym.scenario.Streams.seeded(7))
    seen = [env.reset(options={"episode": episode})[0] for env in (used, fresh)]
    for _ in range(20):
        assert same(*seen)
        seen = [env.step(zero(None))[0] for env in (used, fresh)]


def test_inputs_can_be_seen_beside_slot_actions() -> None:
    env = SenderEnv(
        "lte", 8, fields="guided", observation="flat", size_bytes=400_000, size_cv=0.5, duration_s=10.0, actions="slots"
    )
    seen, info = env.reset(seed=0)
    assert env.action_space == gym.spaces.Discrete(10) and info["action_mask"].sum() == 2
    assert env.observation_space == gym.spaces.Box(-4, 4, (len(INPUTS),), np.float32)
    ended, all_seen = False, []
    while not ended:
        all_seen.append(seen)
        seen, _, ended, _, info = env.step(9 if info["action_mask"][9] else 0)
    varying = np.ptp(all_seen, axis=0) > 0
    assert np.abs(all_seen).max() <= 3
    assert {name for name, varies in zip(INPUTS, varying, strict=True) if not varies} == {"one"}


@pytest.mark.parametrize("env_id", ["bufgym/Uplink-v0", "bufgym/Suite-v0", "bufgym/Interruption-v0"])
def test_gymnasiums_checker_has_nothing_to_say(env_id: str) -> None:
    env = gym.make(env_id, actions="guided", fields="guided", **SMALL[env_id])
    assert env.action_space == gym.spaces.Box(-1, 1, (10,), np.float32) and list(env.observation_space) == list(INPUTS)
    check_env(env.unwrapped)
    envs = gym.make_vec(env_id, 2, actions="guided", fields="guided", **SMALL[env_id])
    envs.reset(seed=0)
    envs.action_space.seed(0)
    _, _, _, _, info = envs.step(envs.action_space.sample())
    assert "action_mask" not in info


def begun() -> tuple[SenderEnv, SenderVectorEnv]:
    env, envs = SenderEnv(actions="guided"), SenderVectorEnv(2, actions="guided")
    env.reset(seed=0)
    envs.reset(seed=0)
    return env, envs


test_a_wrong_option_or_action_ends_in_a_sentence = refused(
    (lambda: SenderEnv(actions="guide"), "unknown actions 'guide'; did you mean 'guided'?"),
    (
        lambda: SenderEnv(fields="guide", actions="slots"),
        "fields = 'guide': must be a list of names, 'compact' or 'guided'",
    ),
    (lambda: SenderEnv("topics", actions="guided"), "actions = 'guided': .*, not several topics"),
    (lambda: SenderEnv("topics", fields="guided"), "fields = 'guided': .*, not several topics"),
    (lambda: FleetVecEnv(actions="guided"), "actions = 'guided': .*, not a cell of robots"),
    (lambda: expert.policy(SenderEnv(actions="guided"), "afr"), "an expert answers with slots"),
    (lambda: begun()[0].step(np.full(10, 2.0)), r"action: 2.0 must lie in -1..1"),
    (lambda: begun()[0].step(np.full(10, np.nan)), r"action: nan must lie in"),
    (lambda: begun()[0].step(3), r"action is int64\[\]: must be float\[10\]: threshold, discount"),
    (lambda: begun()[1].step(np.zeros(10)), r"actions is float64\[10\]: must be float\[2, 10\]"),
)

"""The batched environment: row i is the single environment with row i's seed, bit for bit, in Gymnasium's own forms."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import DYING, FADING, client, valid_action
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, FlattenObservation, RecordEpisodeStatistics
from refusal_cases import refused

from bufgym.envs import SenderEnv, SenderVectorEnv
from bufgym.model import qoi
from bufgym.scenario import Interruption, Scenario, Uplink
from bufgym.scenario.suites.mixture import SuiteScenario
from bufgym.sim.state import ARRIVAL_WAITS, SOCKET_WAITS

kernels = pytest.mark.kernels
CASES: dict[str, tuple[Scenario, dict[str, Any]]] = {
    "interruption": (Interruption(t_max=25), {}),
    "fading": (Uplink(traces=(FADING,), jitter=0.8, size_cv=0.7, duration_s=1.0), {"max_bytes": 600_000}),
    "dying": (
        Uplink(traces=(DYING,), duration_s=0.8, value=qoi.saturating(3.0)),
        {"decide_at": "overflow", "reward": {"delivered": 0.3, "retained": 0.7}},
    ),
    "suite": (SuiteScenario("interruption-v1"), {"bound": True}),  # three V side by side
    "topics": (client(duration_s=0.6, scale=2.0), {}),
    "topics in a window": (client(duration_s=0.6, window=3, round_trip_us=30_000), {"reward": "late"}),
    "short": (Uplink(traces=(FADING,), jitter=0.8, duration_s=0.4), {}),  # several episodes of 12 messages
    "asks nothing": (Interruption(t_max=3), {"decide_at": "overflow"}),  # each episode ends with its first step
}
L, N = 4, 3
NEXT_STEP, SAME_STEP = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP


def vector(case: str, **more: Any) -> SenderVectorEnv:
    scenario, arguments = CASES[case]
    return SenderVectorEnv(N, scenario, L, **arguments, **{"actions": "slots", **more})


def single(case: str, **more: Any) -> SenderEnv:
    scenario, arguments = CASES[case]
    return SenderEnv(scenario, L, **arguments, **{"actions": "slots", **more})


def row(info: dict[str, Any], i: int) -> dict[str, Any]:
    """Row ``i`` of a vector environment's info, where ``_key`` says who has ``key``."""
    entries: dict[str, Any] = {}
    for key, column in info.items():
        if not key.startswith("_") and info[f"_{key}"][i]:
            entries[key] = row(column, i) if isinstance(column, dict) else column[i]
    return entries


def assert_same(a: Any, b: Any) -> None:
    """Equal to the last bit, dictionaries by key."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, np.ndarray) and a.dtype == object:
        for item, other in zip(a, b, strict=True):
            assert_same(item, other)
    else:
        np.testing.assert_array_equal(a, b, strict=isinstance(a, np.ndarray) and isinstance(b, np.ndarray))


def pick(batch: dict[str, Any], i: int) -> dict[str, Any]:
    return {name: array[i] for name, array in batch.items()}


def actions_of(rng: np.random.Generator, envs: SenderVectorEnv) -> np.ndarray[Any, Any]:
    """Half of them valid for sure, the others at random."""
    if isinstance(envs.single_action_space, gym.spaces.Box):
        return rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
    masks = envs.action_masks()
    valid = [valid_action(mask, rng) for mask in masks]
    return np.where(rng.random(len(masks)) < 0.5, valid, rng.integers(L + 2, size=len(masks)))


FORMS: list[dict[str, Any]] = [
    {"observation": "flat"},
    {"observation": "flat", "fields": ["loss", "rank", "busy"], "info": "mask"},
    {"fields": ["busy"]},
]


@pytest.mark.parametrize("mode", [NEXT_STEP, SAME_STEP])
@pytest.mark.parametrize(
    ("case", "limit", "options"),
    [
        *((case, None, {}) for case in CASES),
        *((case, 4, {}) for case in (*CASES,)[:-1]),
        *((case, None, form) for case in ("fading", "topics") for form in FORMS),
    ],
)
def test_equal_to_gymnasiums_vector_of_single_environments(case: str, mode: Any, limit: Any, options: Any) -> None:
    """Row i is the single environment with seed s + i, bit for bit, in all that it returns."""
    check_equal_to_sync(case, mode, limit, 150, **options)


@kernels
@pytest.mark.parametrize(("case", "mode"), [("fading", NEXT_STEP), ("topics", SAME_STEP), ("asks nothing", NEXT_STEP)])
def test_equal_for_a_few_steps(case: str, mode: Any) -> None:
    check_equal_to_sync(case, mode, None, 15)


def check_equal_to_sync(case: str, mode: AutoresetMode, limit: int | None, steps: int, **options: Any) -> None:
    """The batch and Gymnasium's own vector of single environments return the same."""

    def one() -> gym.Env[Any, Any]:
        env = single(case, **options)
        return env if limit is None else gym.wrappers.TimeLimit(env, limit)

    envs = vector(case, autoreset_mode=mode, max_episode_steps=limit, **options)
    sync = SyncVectorEnv([one] * N, autoreset_mode=mode)
    assert envs.observation_space == sync.observation_space
    assert envs.action_space == sync.action_space
    assert envs.single_observation_space == sync.single_observation_space
    assert envs.metadata["autoreset_mode"] == sync.metadata["autoreset_mode"]
    (observations, infos), (expected_observations, expected_infos) = envs.reset(seed=8), sync.reset(seed=8)
    assert_same(observations, expected_observations)
    assert envs.np_random_seed == sync.np_random_seed == (8, 9, 10)
    for i in range(N):
        assert_same(row(infos, i), row(expected_infos, i))
    rng, truncations, episodes, questions = np.random.default_rng(1), 0, 0, set()
    for _ in range(steps):
        actions = actions_of(rng, envs)
        questions.add(frozenset(envs.sub_envs.senders.batch.senders["waiting"].tolist()))
        step, expected = envs.step(actions), sync.step(actions)
        for a, b in zip(step[:4], expected[:4], strict=True):
            assert_same(a, b)
        episodes += int(step[2].sum())
        truncations += int(step[3].sum())
        infos, expected_infos = step[4], expected[4]
        assert ("final_obs" in infos) == ("final_obs" in expected_infos)
        if "final_obs" in infos:
            assert infos["final_obs"].dtype == expected_infos["final_obs"].dtype == object
        for i in range(N):
            own, expected_own = row(infos, i), row(expected_infos, i)
            if step[3][i] and not step[2][i]:
                # The environment inside the wrapper does not know that its episode was cut, so it gives no summary.
                last = own.get("final_info", own)
                assert last["qoi"] == expected_own.get("final_info", expected_own)["qoi"]
                assert last.pop("arrived") >= last.pop("delivered") + last.pop("dropped")
            assert_same(own, expected_own)
            assert_same(envs.action_masks()[i], sync.envs[i].unwrapped.action_masks())
    assert (truncations > 0) == (limit is not None)
    assert limit is not None or episodes >= N or steps < 100
    if envs.sub_envs.senders.topics and limit is None and steps > 100:  # both kinds of question in one step
        assert any({ARRIVAL_WAITS, SOCKET_WAITS} <= kinds for kinds in questions)


@pytest.mark.parametrize("case", ["fading", "topics"])
def test_threads_change_nothing(case: str) -> None:
    """Three rows in two threads are what they are in one, and more threads than rows are as many."""
    one, two, many = vector(case), vector(case, num_threads=2), vector(case, num_threads=9)
    assert [len(part) for part in two.sub_envs._threads.parts] == [2, 1] and len(many.sub_envs._threads.parts) == N
    for envs in (one, two, many):
        envs.reset(seed=8)
    rng = np.random.default_rng(1)
    for _ in range(60):
        actions = actions_of(rng, one)
        step, *others = (envs.step(actions) for envs in (one, two, many))
        for other in others:
            for result, expected in zip(other, step, strict=True):
                assert_same(result, expected)


@pytest.mark.parametrize("case", ["fading", "topics"])
def test_the_forms_hold_the_same_numbers(case: str) -> None:
    """flat is what ``FlattenObservation`` makes of the dict."""
    several = {form: vector(case, observation=form) for form in ("dict", "flat")}
    assert several["flat"].single_observation_space == FlattenObservation(several["dict"]).single_observation_space
    seen: dict[str, Any] = {form: envs.reset(seed=4)[0] for form, envs in several.items()}
    rng = np.random.default_rng(0)
    for _ in range(20):
        fields = seen["dict"]
        assert_same(seen["flat"], np.concatenate(list(fields.values()), axis=1))
        for form, envs in several.items():
            assert envs.observation_space.contains(seen[form])
        actions = actions_of(rng, several["dict"])
        seen = {form: envs.step(actions)[0] for form, envs in several.items()}


def test_seeds_are_told_as_gymnasium_tells_them() -> None:
    envs, sync = vector("interruption"), SyncVectorEnv([lambda: single("interruption")] * N)
    envs.reset(seed=[4, 1, 9]), sync.reset(seed=[4, 1, 9])
    assert envs.np_random_seed == sync.np_random_seed == (4, 1, 9)
    envs.reset(seed=[None, 2, None]), sync.reset(seed=[None, 2, None])
    assert envs.np_random_seed == sync.np_random_seed == (4, 2, 9)
    assert [rng.random() for rng in envs.np_random] == [rng.random() for rng in sync.np_random]
    assert len(set(vector("interruption").np_random_seed)) == N


def test_autoreset_by_hand() -> None:
    envs = SenderVectorEnv(2, "interruption", L, law="fixed", t_max=3, autoreset_mode="Disabled", actions="slots")
    alone = [SenderEnv("interruption", L, law="fixed", t_max=3, actions="slots") for _ in range(2)]
    episodes = [Interruption(t_max=3).episode(1), Interruption(t_max=3).episode(3)]
    envs.reset(seed=0, options={"episodes": episodes})
    for i in range(2):
        alone[i].reset(seed=i, options={"episode": episodes[i]})
    _, _, terminated, _, info = envs.step(np.array([L + 1, L + 1]))
    alone[1].step(L + 1)
    assert terminated.tolist() == [True, False]
    assert info["_arrived"].tolist() == [True, False]
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        envs.step(np.array([0, 0]))
    observations, infos = envs.reset(options={"reset_mask": terminated})
    assert_same(pick(observations, 0), alone[0].reset()[0])
    for _ in range(2):  # row 1 goes on where it was
        observations, rewards, terminated, _, infos = envs.step(np.array([L, 0]))
        for i, action in ((0, L), (1, 0)):
            observation, reward, ended, _, info = alone[i].step(action)
            assert_same(pick(observations, i), observation)
            assert (rewards[i], terminated[i]) == (reward, ended)
    assert terminated.tolist() == [False, True]
    assert infos["arrived"][1] == 5


@pytest.mark.parametrize(
    ("mode", "form"), [("NextStep", "dict"), ("SameStep", "flat"), ("SameStep", "dict"), ("Disabled", "dict")]
)
def test_arrays_handed_out_are_never_written_again(mode: str, form: str) -> None:
    envs = vector("fading", autoreset_mode=mode, max_episode_steps=9, observation=form)
    rng = np.random.default_rng(0)
    held: list[Any] = [envs.reset(seed=3)]
    copies = [copy.deepcopy(held[0])]

    def keep(step: Any) -> None:
        held.append(step)
        copies.append(copy.deepcopy(step))

    for k in range(50):
        masks = envs.action_masks()
        keep(masks)
        keep(envs.step(actions_of(rng, envs)))
        done = held[-1][2] | held[-1][3]
        if mode == "Disabled" and done.any():
            keep(envs.reset(options={"reset_mask": done}))
        elif k % 20 == 19:
            keep(envs.reset())
    for before, now in zip(copies, held, strict=True):
        for a, b in zip(before, now, strict=True):
            assert_same(a, b)


def test_gymnasiums_wrappers_understand_the_infos() -> None:
    envs: Any = DictInfoToList(RecordEpisodeStatistics(FlattenObservation(vector("interruption", reward="retained"))))
    envs.reset(seed=0)
    finished = 0
    for _ in range(60):
        observations, _, _, _, infos = envs.step(np.full(N, L))
        assert envs.observation_space.contains(observations)
        for info in infos:
            if "arrived" in info:
                finished += 1
                assert info["episode"]["r"] == pytest.approx(max(0, info["qoi"] - 1))
    assert finished > N


def begun() -> SenderVectorEnv:
    envs = vector("interruption")
    envs.reset(seed=[1, None, 3])
    return envs


@pytest.mark.parametrize("mode", [SAME_STEP, "SameStep", "SAME_STEP"])
def test_autoreset_in_each_way_that_gymnasium_has(mode: Any) -> None:
    native = gym.make_vec("bufgym/Uplink-v1", 2, autoreset_mode=mode, actions="slots")
    kwargs = {"autoreset_mode": native.metadata["autoreset_mode"]}
    sync = gym.make_vec("bufgym/Uplink-v1", 2, "sync", vector_kwargs=kwargs, actions="slots")
    assert native.metadata["autoreset_mode"] is sync.metadata["autoreset_mode"] is SAME_STEP


RESET, INVALID = gym.error.ResetNeeded, gym.error.InvalidAction


test_wrong_use_is_named = refused(
    (lambda: SenderVectorEnv(0, actions="slots"), "num_envs = 0"),
    (lambda: SenderVectorEnv(autoreset_mode="Sometimes", actions="slots"), "autoreset_mode = 'Sometimes'"),
    (
        lambda: gym.make_vec("bufgym/Uplink-v1", 1, "sync", autoreset_mode="SameStep", actions="slots"),
        "SyncVectorEnv by vector_kwargs",
    ),
    *(
        (lambda n=n: SenderVectorEnv(max_episode_steps=n, actions="slots"), "max_episode_steps = ")
        for n in (0, 1.5, "5")
    ),
    (lambda: SenderVectorEnv(observation="vector", actions="slots"), "must be one of 'dict', 'flat', None"),
    (lambda: SenderVectorEnv(info="some", actions="slots"), "must be one of 'full', 'summary', 'mask'"),
    (lambda: SenderVectorEnv(info="summary", actions="slots"), "info = 'summary': is for recorders"),
    (lambda: SenderVectorEnv(num_threads=0, actions="slots"), "num_threads = 0: must be"),
    (lambda: vector("interruption").step(np.zeros(N, np.int64)), "call reset", RESET),
    (lambda: vector("interruption").reset(options={"reset_mask": np.arange(N) > 0}), "no episode yet", RESET),
    (lambda: vector("interruption").reset(seed=[1, 2]), "2 seeds for 3"),
    (lambda: begun().reset(options={"reset_mask": np.array([True])}), r"reset_mask'\] is bool\[1\]: must be bool\[3\]"),
    (lambda: begun().reset(options={"reset_mask": np.array([0, 2, 1])}), r"is int64\[3\]: must be bool\[3\]"),
    (lambda: begun().reset(options={"episodes": [None]}), "must be a list of 3, one for each environment"),
    (lambda: begun().step(np.array([0, 5, 6])), r"actions\[2\] = 6: must be a whole number in 0\.\.5"),
    (lambda: begun().step(np.array([0, 1.7, 2])), "actions are float64: must be whole numbers", INVALID),
    (lambda: begun().step(np.zeros(N + 1, np.int64)), "shape"),
)

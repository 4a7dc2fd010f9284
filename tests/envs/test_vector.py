"""The batched environment: row i is the single environment with row i's seed, bit for bit, in Gymnasium's own forms."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import SMALL, client, valid_action
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, FlattenObservation, RecordEpisodeStatistics

import bufgym
from bufgym.envs import SenderEnv, SenderVectorEnv
from bufgym.errors import BufgymError
from bufgym.kernel import JIT
from bufgym.model import qoi
from bufgym.scenario import Interruption, Scenario, Uplink
from bufgym.scenario.suites.mixture import SuiteScenario
from bufgym.sim import ARRIVAL_WAITS, SOCKET_WAITS
from bufgym.traces import Trace

FADING = Trace.steps([(0.4, 9e6), (0.5, 0), (0.6, 2e6)])
DYING = Trace.steps([(0.4, 9e6), (0.3, 1e6)], after="stop")

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
}
L, N = 4, 3
STEPS = 150 if JIT else 90


def vector(case: str, **more: Any) -> SenderVectorEnv:
    scenario, arguments = CASES[case]
    return SenderVectorEnv(N, scenario, L, **arguments, **more)


def single(case: str, **more: Any) -> SenderEnv:
    scenario, arguments = CASES[case]
    return SenderEnv(scenario, L, **arguments, **more)


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


def actions_of(rng: np.random.Generator, masks: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Half of them valid for sure, the others at random."""
    valid = [valid_action(mask, rng) for mask in masks]
    return np.where(rng.random(len(masks)) < 0.5, valid, rng.integers(L + 2, size=len(masks)))


@pytest.mark.parametrize("limit", [None, 4])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("case", CASES)
def test_equal_to_gymnasiums_vector_of_single_environments(case: str, mode: AutoresetMode, limit: int | None) -> None:
    """Row i is the single environment with seed s + i, bit for bit, in all that it hands out."""
    check_equal_to_sync(case, mode, limit)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("case", ["fading", "topics"])
@pytest.mark.parametrize(
    "options",
    [
        {"observation": "flat"},
        {"observation": "flat", "fields": ["loss", "rank", "busy"], "info": "mask"},
        {"observation": "slots", "info": "none"},
        {"observation": "slots", "fields": ["loss", "rank", "busy"]},
        {"observation": "slots", "fields": ["busy"]},
    ],
)
def test_equal_in_every_form(case: str, mode: AutoresetMode, options: dict[str, Any]) -> None:
    check_equal_to_sync(case, mode, None, **options)


@pytest.mark.parametrize("case", ["fading", "topics"])
def test_threads_change_nothing(case: str) -> None:
    """Three rows in two threads are what they are in one, and more threads than rows are as many."""
    one, two, many = vector(case), vector(case, num_threads=2), vector(case, num_threads=9)
    assert [len(part) for part in two.rows._threads.parts] == [2, 1] and len(many.rows._threads.parts) == N
    for envs in (one, two, many):
        envs.reset(seed=8)
    rng = np.random.default_rng(1)
    for _ in range(STEPS):
        actions = actions_of(rng, one.action_masks())
        (observations, *results), *others = (envs.step(actions) for envs in (one, two, many))
        for observed, *rest in others:
            assert_same(observed, observations)
            for result, expected in zip(rest, results, strict=True):
                assert_same(result, expected)


def check_equal_to_sync(case: str, mode: AutoresetMode, limit: int | None, **options: Any) -> None:
    """The batch and Gymnasium's own vector of single environments hand out the same."""

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
    for _ in range(STEPS):
        actions = actions_of(rng, envs.action_masks())
        questions.add(frozenset(envs.rows.senders.batch.senders["waiting"].tolist()))
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
                # The wrapper that truncates asks for no summary.
                last = own.get("final_info", own)
                assert last["qoi"] == expected_own.get("final_info", expected_own)["qoi"]
                assert last.pop("arrived") >= last.pop("delivered") + last.pop("dropped")
            assert_same(own, expected_own)
            assert_same(envs.action_masks()[i], sync.envs[i].unwrapped.action_masks())
    assert (truncations > 0) == (limit is not None)
    assert limit is not None or episodes > N
    if envs.rows.senders.topics and limit is None:  # both kinds of question in one step
        assert any({ARRIVAL_WAITS, SOCKET_WAITS} <= kinds for kinds in questions)


@pytest.mark.parametrize("case", ["fading", "topics"])
def test_the_forms_hold_the_same_numbers(case: str) -> None:
    """flat is what ``FlattenObservation`` makes of the dict; slots are its slot fields side by side."""
    several = {form: vector(case, observation=form) for form in ("dict", "flat", "slots")}
    flattened = FlattenObservation(several["dict"])
    assert several["flat"].single_observation_space == flattened.single_observation_space
    seen: dict[str, Any] = {form: envs.reset(seed=4)[0] for form, envs in several.items()}
    rng = np.random.default_rng(0)
    for _ in range(40):
        fields = seen["dict"]
        assert_same(seen["flat"], np.concatenate(list(fields.values()), axis=1))
        per_slot = [column for column in fields.values() if column.shape[1] == L + 1]
        assert_same(seen["slots"]["slots"], np.stack(per_slot, axis=-1))
        assert_same(seen["slots"]["context"], np.concatenate(list(fields.values())[len(per_slot) :], axis=1))
        for form, envs in several.items():
            assert envs.observation_space.contains(seen[form])
        actions = actions_of(rng, several["dict"].action_masks())
        seen = {form: envs.step(actions)[0] for form, envs in several.items()}


def test_with_all_fields_nothing_is_copied() -> None:
    for form in ("dict", "flat", "slots"):
        envs = vector("fading", observation=form)
        observation: Any = envs.reset(seed=0)[0]
        for array in observation.values() if isinstance(observation, dict) else [observation]:
            assert np.shares_memory(array, envs.rows.output.flat)
        few: Any = vector("fading", observation=form, fields=["rank"]).reset(seed=0)[0]
        assert few.shape == (N, L + 1) if form == "flat" else len(few) == 1


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_info_is_built_as_far_as_asked(mode: str) -> None:
    """T = 2, all accepted: the second step delivers 0, 1, 2, 3 and ends the episode."""
    summary = {"qoi": 1 + 3 * (1 - 0.618), "arrived": 4, "delivered": 4, "dropped": 0, "invalid": 0}
    for info, always in (
        ("full", {"action_mask", "qoi", "invalid", "reward_terms"}),
        ("mask", {"action_mask"}),
        ("none", set()),
    ):
        envs = SenderVectorEnv(2, "interruption", L, law="fixed", t_max=2, info=info, autoreset_mode=mode)
        alone = SenderEnv("interruption", L, law="fixed", t_max=2, info=info)
        for found in (envs.reset(seed=0)[1], envs.step(np.full(2, L + 1))[4]):
            assert {name for name in found if not name.startswith("_")} == always
        assert alone.reset(seed=0)[1].keys() == alone.step(L + 1)[4].keys() == always
        found = envs.step(np.full(2, L + 1))[4]
        last = found["final_info"] if mode == "SameStep" else found
        assert row(last, 1).keys() == alone.step(L + 1)[4].keys() == always | summary.keys()
        assert {name: last[name][1] for name in summary} == pytest.approx(summary)


@pytest.mark.parametrize("stands", [True, False])
def test_a_truncated_episode_has_its_qoi(stands: bool) -> None:
    """Five of nine messages: over a link that stands still none is delivered; over a fast one five, one on its way."""
    link = Trace.steps([(9.0, 0.0 if stands else 9e6), (1.0, 9e6)])
    scenario = Uplink(traces=(link,), duration_s=0.3, random_offset=False)
    settings: dict[str, Any] = {"scenario": scenario, "max_episode_steps": 5}
    env = gym.make("bufgym/Uplink-v0", **settings)
    envs: Any = gym.make_vec("bufgym/Uplink-v0", 2, vectorization_mode="vector_entry_point", **settings)
    env.reset(seed=0), envs.reset(seed=0)
    for _ in range(5):
        *_, truncated, info = env.step(9)
        *_, all_truncated, infos = envs.step(np.array([9, 9]))
    assert truncated and all_truncated.all()
    # 230 kB take 26 ms of the 33 ms to the next arrival, propagation 20 ms.
    transmitted, received = (0, 0) if stands else (5, 4)
    x = env.unwrapped.rows.senders.episodes[0].arrivals["x"][:received]  # type: ignore[attr-defined]
    assert infos["delivered"].tolist() == [transmitted] * 2
    assert infos["qoi"][0] == info["qoi"] == pytest.approx(scenario.value.information(x))


def test_seeds_are_told_as_gymnasium_tells_them() -> None:
    envs, sync = vector("interruption"), SyncVectorEnv([lambda: single("interruption")] * N)
    envs.reset(seed=[4, 1, 9]), sync.reset(seed=[4, 1, 9])
    assert envs.np_random_seed == sync.np_random_seed == (4, 1, 9)
    envs.reset(seed=[None, 2, None]), sync.reset(seed=[None, 2, None])
    assert envs.np_random_seed == sync.np_random_seed == (4, 2, 9)
    assert [rng.random() for rng in envs.np_random] == [rng.random() for rng in sync.np_random]
    unseeded = vector("interruption")
    assert len(set(unseeded.np_random_seed)) == N


@pytest.mark.parametrize("mode", ["vector_entry_point", "sync"])
@pytest.mark.parametrize("env_id", bufgym.ENVIRONMENTS)
def test_make_vec(env_id: str, mode: str) -> None:
    envs = gym.make_vec(env_id, num_envs=N, vectorization_mode=mode, capacity=3, **SMALL[env_id])
    assert envs.num_envs == N
    assert envs.single_action_space == gym.spaces.Discrete(5)
    observations, _ = envs.reset(seed=2)
    assert envs.observation_space.contains(observations)
    for _ in range(30):
        observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
        assert envs.observation_space.contains(observations)
        assert rewards.shape == terminated.shape == truncated.shape == (N,)
        assert infos["action_mask"].shape == (N, 5)
    envs.close()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_make_vec_cuts_episodes_off(mode: str) -> None:
    envs = gym.make_vec(
        "bufgym/Interruption-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        max_episode_steps=5,
        law="fixed",
        t_max=20,
        autoreset_mode=mode,
    )
    envs.reset(seed=0)
    cut = [envs.step(np.array([8, 8]))[3].all() for _ in range(17)]
    if mode == "SameStep":
        assert np.flatnonzero(cut).tolist() == [4, 9, 14]
    else:  # each reset takes a step of its own
        assert np.flatnonzero(cut).tolist() == [4, 10, 16]


def test_autoreset_by_hand() -> None:
    envs = SenderVectorEnv(2, "interruption", L, law="fixed", t_max=3, autoreset_mode="Disabled")
    alone = [SenderEnv("interruption", L, law="fixed", t_max=3) for _ in range(2)]
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


def test_a_first_reset_may_leave_out_no_row() -> None:
    envs = vector("interruption")
    with pytest.raises(gym.error.ResetNeeded, match="no episode yet"):
        envs.reset(options={"reset_mask": np.array([False, True, True])})


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("form", ["dict", "flat", "slots"])
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
        keep(envs.step(actions_of(rng, masks)))
        done = held[-1][2] | held[-1][3]
        if mode == "Disabled" and done.any():
            keep(envs.reset(options={"reset_mask": done}))
        elif k % 20 == 19:
            keep(envs.reset())
    for before, now in zip(copies, held, strict=True):
        for a, b in zip(before, now, strict=True):
            assert_same(a, b)


@pytest.mark.parametrize("form", ["dict", "flat", "slots"])
def test_arrays_that_nobody_holds_are_used_again(form: str) -> None:
    envs = vector("fading", observation=form)
    envs.reset(seed=0)
    for _ in range(60):
        step = envs.step(np.full(N, L))
    assert len(envs._pool) <= 4
    assert step[1].shape == (N,)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_gymnasiums_wrappers_understand_the_infos(mode: str) -> None:
    """Those that accept the mode: in Gymnasium 1.4 some refuse SAME_STEP altogether."""
    envs: Any = vector("interruption", autoreset_mode=mode)
    if mode == "NextStep":
        envs = RecordEpisodeStatistics(FlattenObservation(envs))
    envs = DictInfoToList(envs)
    envs.reset(seed=0)
    finished = 0
    for _ in range(60):
        observations, _, _, _, infos = envs.step(np.full(N, L))
        assert envs.observation_space.contains(observations)
        for info in infos:
            ended = info.get("final_info", info)
            if "arrived" in ended:
                finished += 1
                assert mode == "NextStep" or envs.single_observation_space.contains(info["final_obs"])
                assert mode == "SameStep" or info["episode"]["r"] == pytest.approx(max(0, info["qoi"] - 1))
    assert finished > N


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"num_envs": 0}, "num_envs = 0"),
        ({"num_envs": 1.5}, "num_envs = 1.5"),
        ({"autoreset_mode": "Sometimes"}, "autoreset_mode = 'Sometimes'"),
        ({"max_episode_steps": 0}, "max_episode_steps = 0"),
        ({"render_mode": "human"}, "render_mode = 'human'"),
        ({"observation": "vector"}, "observation = 'vector': must be one of 'dict', 'flat', 'slots'"),
        ({"info": "some"}, "info = 'some': must be one of 'full', 'steady', 'mask', 'none'"),
    ],
)
def test_wrong_arguments_are_named(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(BufgymError) as caught:
        SenderVectorEnv(**arguments)
    assert says in str(caught.value)


def test_a_batch_has_no_steady_infos() -> None:
    with pytest.raises(BufgymError, match="info = 'steady': is for recorders"):
        vector("fading", info="steady")


def test_no_threads_are_an_error() -> None:
    with pytest.raises(BufgymError, match="num_threads = 0: must be"):
        vector("fading", num_threads=0)


def test_wrong_calls_are_named() -> None:
    envs = vector("interruption")
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(np.zeros(N, np.int64))
    with pytest.raises(BufgymError, match="2 seeds for 3"):
        envs.reset(seed=[1, 2])
    with pytest.raises(BufgymError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.array([True])})
    envs.reset(seed=[1, None, 3])
    with pytest.raises(BufgymError, match=r"actions\[2\] = 6: must lie in 0\.\.5"):
        envs.step(np.array([0, 5, 6]))
    with pytest.raises(BufgymError, match=r"actions\[1\] = -1"):
        envs.step(np.array([0, -1, 6]))
    with pytest.raises(BufgymError, match="actions are float64: must be whole numbers"):
        envs.step(np.array([0, 1.7, 2]))
    with pytest.raises(BufgymError, match="shape"):
        envs.step(np.zeros(N + 1, np.int64))

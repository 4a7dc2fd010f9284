"""Experts: values that hold for every sequence of actions, policies that say what they would do, their data sets."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import valid_action
from hypothesis import example, given
from hypothesis import strategies as st
from needs import needs
from refusal_cases import refuse, refused

from bufgym import oracle, policies
from bufgym.cli import main
from bufgym.envs import SenderEnv, SenderVectorEnv, expert
from bufgym.envs.expert.dataset import KINDS, record
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.oracle import law, online_optimum
from bufgym.policies import Policy
from bufgym.scenario import Episode, Interruption, Uplink, messages
from bufgym.scenario.numbered import draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

V = qoi.exponential(0.5)
LINK = (Trace.steps([(1.0, 900_000), (0.7, 100_000)], name="t"),)
SHORT = Uplink(traces=LINK, rate_hz=20, duration_s=5, size_bytes=90_000, value=V)


def trace(knots: list[tuple[int, int]], after: str = "loop") -> Trace:
    """A link by its knots (us, bytes)."""
    times, carried = zip(*knots, strict=True)
    return Trace("made", np.array(times, np.int64), np.array(carried, np.int64), after=after)


def playing(episode: Episode, capacity: int, v: Any = V, **options: Any) -> SenderEnv:
    """An environment at the first decision of this episode."""
    env = SenderEnv(replace(SHORT, value=v, rate_hz=200), capacity, **options, actions="slots")
    env.reset(options={"episode": episode})
    return env


def brute(env: SenderEnv) -> dict[int, float]:
    """The best H of all action sequences, by the first of them."""
    arrays = (*env.sub_envs.senders.batch[:5], *env.sub_envs.output, env.sub_envs.rewarded)
    kept, values = [array.copy() for array in arrays], {}
    for action in np.flatnonzero(env.action_masks()).tolist():
        _, _, ended, _, info = env.step(action)
        values[action] = info["qoi"] if ended else max(brute(env).values())
        for array, old in zip(arrays, kept, strict=True):
            array[...] = old
    return values


def check_values(env: SenderEnv, values: np.ndarray) -> None:
    for action, most in brute(env).items():
        assert values[0, action] == pytest.approx(most, abs=1e-9), (action, values)
    assert (np.isnan(values[0]) == ~env.action_masks()).all()


@st.composite
def episodes(draw: Any) -> tuple[Episode, int]:
    """A few messages of 4 bytes over a link of fits and starts, and L."""
    n = draw(st.integers(2, 6))
    gaps = st.lists(st.integers(0, 9), min_size=n, max_size=n)
    times, x = np.cumsum(draw(gaps)), np.cumsum(draw(gaps)) / draw(st.sampled_from([1, 4]))
    x = np.minimum(x, x[draw(st.integers(0, n - 1))])  # it may stand still from some moment on
    steps = draw(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 14)), min_size=1, max_size=5))
    knots = np.cumsum([(0, 0), *steps], axis=0)
    after = draw(st.sampled_from(["stop", "loop", "hold"]))
    if knots[-1, 1] == 0:
        after = "stop"
    link = Link(trace([tuple(map(int, knot)) for knot in knots], after), draw(st.integers(0, 5)))
    return Episode(messages(times, 4, x), link), draw(st.integers(1, 3))


DEAD = Episode(messages([0, 1, 2], 4, [0.0, 1.0, 2.0]), Link(trace([(0, 0), (5, 2)], "stop"), 0))
"""The link ends in the midst of the first message, which never leaves the socket."""


STANDS = Episode(messages(range(0, 15, 3), 4, [0.0, 1.0, 2.0, 3.0, 3.0]), Link(trace([(0, 0), (10, 4)]), 0))
"""The robot stands still from the fourth message on: nothing gains after it, yet the fifth may stand in for it."""


@pytest.mark.kernels
@example((DEAD, 1), V, [0])
@example((STANDS, 1), V, [0, 1, 2])
@example((STANDS, 3), V, [0, 1, 2])
@given(episodes(), st.sampled_from([V, qoi.saturating(3.0)]), st.lists(st.integers(0, 2**32 - 1), max_size=4))
def test_values_are_those_of_all_action_sequences(case: tuple[Episode, int], v: Any, seeds: list[int]) -> None:
    """At the start, and after actions at random."""
    episode, capacity = case
    env = playing(episode, capacity, v)
    know = expert.clairvoyant(env)
    for seed in seeds:
        _, _, ended, _, _ = env.step(valid_action(env.action_masks(), np.random.default_rng(seed)))
        if ended:
            assert np.isnan(know.values()).all() and know.actions().tolist() == [capacity]
            return
    check_values(env, know.values())


FAMILIES = (SHORT, Interruption(t_max=90, law="fixed", value=V), replace(SHORT, rate_hz=60))


@pytest.mark.parametrize("capacity", [1, 4])
@pytest.mark.parametrize("steps_at_random", [0, 15])
@pytest.mark.parametrize("family", FAMILIES)
def test_who_follows_it_earns_what_it_says(family: Any, steps_at_random: int, capacity: int) -> None:
    """From the start and after actions at random, in a batch, whose rows are those of the single environment."""
    n, rng = 4, np.random.default_rng(1)
    envs = SenderVectorEnv(n, family, capacity, autoreset_mode="Disabled", actions="slots")
    envs.reset(options={"episodes": [draw(family, seed) for seed in range(n)]})
    know = expert.clairvoyant(envs)
    for _ in range(steps_at_random):
        envs.sub_envs.step(np.array([valid_action(mask, rng) for mask in envs.action_masks()]))
    promised = np.nanmax(know.values(), axis=1)
    while not envs.sub_envs.output.terminated.all():
        actions = know.actions()
        given_away = know.regrets()[np.arange(n), actions]
        assert (np.isnan(given_away) | (given_away < 1e-9)).all()
        envs.sub_envs.step(actions)
    assert envs.sub_envs.output.qoi == pytest.approx(promised, abs=1e-7)  # of values within 1e-9 any may be taken
    if steps_at_random == 0:
        best = [oracle.clairvoyant(draw(family, seed), capacity, V).qoi for seed in range(n)]
        assert promised == pytest.approx(best, abs=1e-9)


def test_many_episodes_share_its_room() -> None:
    """Steps of past episodes make room for new ones, and those of the others stay what they were."""
    n, steps, duration_s = (8, 100, 10.0)
    envs = SenderVectorEnv(n, replace(SHORT, duration_s=duration_s), 4, autoreset_mode="SameStep", actions="slots")
    envs.reset(seed=0)
    clairvoyant = expert.clairvoyant(envs)
    know = clairvoyant._hindsight
    for size in (1, 60):  # first so little that it has to grow
        pool = (np.zeros(size, array.dtype) for array in know._ahead[-3:])
        know._ahead = know._ahead._replace(**dict(zip(("latest", "gain", "follow"), pool, strict=True)))
        know._span[:], know._end, know._begun[:] = 0, 0, 0
        envs.reset(seed=size)
        for _ in range(steps):
            envs.reset(options={"reset_mask": np.random.default_rng(size).random(n) < 0.3})
            assert np.array_equal(know.values(), expert.clairvoyant(envs).values(), equal_nan=True)


def judged(scenario: str = "lte", **options: Any) -> Any:
    env = SenderEnv(scenario, **options, actions="slots")
    env.reset(seed=0)
    return expert.clairvoyant(env).values()


test_where_one_is_not_known_it_says_so = refused(
    (lambda: judged("topics"), "several topics"),
    (lambda: judged(size_cv=0.5), "for equal sizes only"),
    (lambda: expert.online(SenderEnv(SHORT, 2, actions="slots")), "Interruption-v1, not for Uplink"),
    (lambda: expert.policy(gym.make("CartPole-v1"), "afr"), "no environment of bufgym"),
)


@pytest.mark.parametrize("name", ["afr", "random", "clairvoyant", "python"])
def test_a_policy_reaches_what_its_rollout_reaches(name: str) -> None:
    """Also where each decision is asked for twice, and where rows end at different times."""
    known = policies.get("afr" if name == "python" else name)
    played = Policy("python", known.on_arrival, memory=known.memory, on_departure=known.on_departure)
    policy = played if name == "python" else known
    n, family = 5, Interruption(t_max=50)
    drawn = [draw(family, seed) for seed in range(2 * n)]
    reached = run(known, drawn, 3, family.value)
    envs: Any = gym.make_vec("bufgym/Interruption-v1", n, capacity=3, scenario=family, actions="slots").unwrapped
    envs.reset(options={"episodes": drawn[:n]})
    asked, last = expert.policy(envs, policy), np.zeros(2 * n)
    for half in (0, n):
        if half:
            envs.reset(options={"episodes": drawn[n:]})
        ended = np.zeros(n, np.bool_)
        while not ended.all():
            actions = asked.actions()
            assert np.array_equal(asked.actions(), actions)
            envs.sub_envs.step(actions)
            ended = envs.sub_envs.output.terminated
        last[half : half + n] = envs.sub_envs.output.qoi
    assert last == pytest.approx([outcome(reached, i).qoi for i in range(2 * n)])


def test_the_online_optimum_is_an_expert_of_interruptions() -> None:
    family = Interruption(t_min=3, t_max=14, law="uniform", value=V)
    env = SenderEnv(family, 2, actions="slots")
    asked, best = expert.online(env), online_optimum(2, law(family), V)
    env.reset(options={"episode": family.episode(9)})
    taken, ended = [], False
    while not ended:
        taken.append(int(asked.actions()[0]))
        _, _, ended, _, _ = env.step(taken[-1])
    kept = [1, 2]
    for position, action in enumerate(taken[2:], 3):
        choice = best.decision([*kept, position])
        assert action == (choice if choice >= 0 else 2)
        kept = [*kept, position][: 3 if choice < 0 else None]
        kept.pop(choice if choice >= 0 else 2)


STREAM = {"duration_s": 2.0, "size_bytes": 500_000}


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_recorded_can_be_played_again(kind: str) -> None:
    """Row 0's episodes, in the single environment with its seed: the same observations, rewards and masks."""
    episodes = list(
        record(SenderVectorEnv(2, "lte", 4, observation="flat", **STREAM, actions="slots"), kind, 6, seed=3)
    )
    assert len(episodes) == 6
    turns = ("expert", "medium", "random") if kind == "mixed" else (kind,) * 3
    env = SenderEnv("lte", 4, observation="flat", **STREAM, actions="slots")
    for k, played in enumerate(episodes[::2]):
        assert played.player == turns[k]
        seen, info = env.reset(seed=3 if k == 0 else None)
        know = expert.clairvoyant(env)
        for t, action in enumerate(played.actions):
            assert np.array_equal(seen, played.observations[t])
            assert np.array_equal(info["action_mask"], played.action_mask[t]) and played.action_mask[t, action]
            assert played.regret is not None and played.regret[t] == know.regrets()[0, action]
            seen, reward, ended, _, info = env.step(action)
            assert reward == played.rewards[t]
        assert ended and np.array_equal(seen, played.observations[-1]) and info["qoi"] == played.qoi[-1]
        episode = env.sub_envs.senders.episodes[0]
        assert episode is not None and played.regret is not None
        # What its decisions gave away one by one is what it lacks in the end.
        most = oracle.clairvoyant(episode, 4, env.sub_envs.senders.value).qoi
        assert info["qoi"] + played.regret.sum() == pytest.approx(most, abs=1e-9)


def test_a_data_set_recovers_its_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    minari = pytest.importorskip("minari", reason=needs("extras", "minari"))
    command = ["dataset", "make", "--env", "Interruption-v1", "--kind", "mixed", "--episodes", "7", "--capacity", "3"]
    command += ["--option", "t_max=20", "--option", "value=saturating:0.5", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "bufgym/interruption/mixed-v0: 7 episodes" in capsys.readouterr().out
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    made = minari.load_dataset("bufgym/interruption/mixed-v0")
    assert made.total_episodes == 7
    env = made.recover_environment()
    assert env.unwrapped.sub_envs.capacity == 3 and env.unwrapped.sub_envs.scenario.t_max == 20
    for episode in made:
        assert len(episode.infos["regret"]) == len(episode.actions) + 1 == len(episode.infos["action_mask"])
        assert episode.terminations[-1] and not episode.truncations.any()
        assert all(mask[action] for mask, action in zip(episode.infos["action_mask"], episode.actions, strict=False))
        assert episode.observations.shape == (len(episode.actions) + 1, 27)
    assert main(command) == 2
    assert "exists already" in capsys.readouterr().err
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith(".bufgym")]


def test_what_fails_leaves_nothing(tmp_path: Path) -> None:
    pytest.importorskip("minari", reason=needs("extras", "minari"))
    from bufgym.envs.expert import dataset

    refuse("for equal sizes only", dataset.make, "Uplink-v1", "random", 2, out=tmp_path, size_cv=0.5, **STREAM)
    with pytest.raises(BufgymError, match="must be of the form"):
        dataset.make("Uplink-v1", "random", 2, out=tmp_path, name="no version!", regret=False, **STREAM)
    assert not [path for path in tmp_path.iterdir() if path.is_dir() and path.name != "bufgym"]


def test_infos_have_the_same_entries_in_every_step() -> None:
    """As recorders that stack them step by step want it."""
    for options in ({}, {"bound": True}):
        env = SenderEnv("lte", 4, info="summary", **STREAM, **options, actions="slots")
        _, info = env.reset(seed=0)
        ended = False
        while not ended:
            _, _, ended, _, after = env.step(4)
            assert after.keys() == info.keys()

"""Experts: values that hold for every sequence of actions, and policies that say what they would do."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import valid_action
from hypothesis import example, given
from hypothesis import strategies as st
from refusal_cases import refused

from bufgym import oracle, policies
from bufgym.envs import SenderEnv, SenderVectorEnv, expert
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.oracle import law, online_optimum
from bufgym.policies import Policy
from bufgym.scenario import Episode, Interruption, Uplink, messages
from bufgym.scenario.numbered import draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace

V = qoi.exponential(0.5)
LINK = (Trace.steps([(1.0, 900_000), (0.7, 100_000)], name="t"),)
SHORT = Uplink(traces=LINK, rate_hz=20, duration_s=5, size_bytes=90_000, value=V)


def trace(knots: list[tuple[int, int]], after: str = "loop") -> Trace:
    """A link by its knots (us, bytes)."""
    times, carried = zip(*knots, strict=True)
    return Trace("made", np.array(times, np.int64), np.array(carried, np.int64), after=after)


def playing(episode: Episode, capacity: int, v: Any = V, **options: Any) -> SenderEnv:
    """An environment at the first decision of this episode."""
    env = SenderEnv(replace(SHORT, value=v, rate_hz=200), capacity, **options)
    env.reset(options={"episode": episode})
    return env


def brute(env: SenderEnv) -> dict[int, float]:
    """The best H of all action sequences, by the first of them."""
    arrays = (*env.rows.senders.batch[:5], *env.rows.output, env.rows.rewarded)
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
    steps = draw(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 14)), min_size=1, max_size=5))
    knots = np.cumsum([(0, 0), *steps], axis=0)
    after = draw(st.sampled_from(["stop", "loop", "hold"]))
    if knots[-1, 1] == 0:
        after = "stop"
    link = Link(trace([tuple(map(int, knot)) for knot in knots], after), draw(st.integers(0, 5)))
    return Episode(messages(times, 4, x), link), draw(st.integers(1, 3))


DEAD = Episode(messages([0, 1, 2], 4, [0.0, 1.0, 2.0]), Link(trace([(0, 0), (5, 2)], "stop"), 0))
"""The link ends in the midst of the first message, which never leaves the socket."""


@pytest.mark.kernels
@example((DEAD, 1), V, [0])
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
    envs = SenderVectorEnv(n, family, capacity, autoreset_mode="Disabled")
    envs.reset(options={"episodes": [draw(family, seed) for seed in range(n)]})
    know = expert.clairvoyant(envs)
    for _ in range(steps_at_random):
        envs.rows.step(np.array([valid_action(mask, rng) for mask in envs.action_masks()]))
    promised = np.nanmax(know.values(), axis=1)
    while not envs.rows.output.terminated.all():
        actions = know.actions()
        given_away = know.regrets()[np.arange(n), actions]
        assert (np.isnan(given_away) | (given_away < 1e-9)).all()
        envs.rows.step(actions)
    assert envs.rows.output.qoi == pytest.approx(promised, abs=1e-7)  # of values within 1e-9 any may be taken
    if steps_at_random == 0:
        best = [oracle.clairvoyant(draw(family, seed), capacity, V).qoi for seed in range(n)]
        assert promised == pytest.approx(best, abs=1e-9)


def test_many_episodes_share_its_room() -> None:
    """Steps of past episodes make room for new ones, and those of the others stay what they were."""
    n, steps, duration_s = (8, 100, 10.0)
    envs = SenderVectorEnv(n, replace(SHORT, duration_s=duration_s), 4, autoreset_mode="SameStep")
    envs.reset(seed=0)
    know = expert.clairvoyant(envs)
    for size in (1, 60):  # first so little that it has to grow
        pool = (np.zeros(size, array.dtype) for array in know._ahead[-3:])
        know._ahead = know._ahead._replace(**dict(zip(("latest", "gain", "follow"), pool, strict=True)))
        know._span[:], know._end, know._begun[:] = 0, 0, 0
        envs.reset(seed=size)
        for _ in range(steps):
            envs.reset(options={"reset_mask": np.random.default_rng(size).random(n) < 0.3})
            assert np.array_equal(know.values(), expert.clairvoyant(envs).values(), equal_nan=True)


def judged(scenario: str = "lte", **options: Any) -> Any:
    env = SenderEnv(scenario, **options)
    env.reset(seed=0)
    return expert.clairvoyant(env).values()


test_where_one_is_not_known_it_says_so = refused(
    (lambda: judged("topics"), "several topics"),
    (lambda: judged(decide_at="overflow"), "decide_at"),
    (lambda: judged(size_cv=0.5), "for equal sizes only"),
    (lambda: expert.online(SenderEnv(SHORT, 2)), "Interruption-v0, not for Uplink"),
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
    envs: Any = gym.make_vec("bufgym/Interruption-v0", n, capacity=3, scenario=family).unwrapped
    envs.reset(options={"episodes": drawn[:n]})
    asked, last = expert.policy(envs, policy), np.zeros(2 * n)
    for half in (0, n):
        if half:
            envs.reset(options={"episodes": drawn[n:]})
        ended = np.zeros(n, np.bool_)
        while not ended.all():
            actions = asked.actions()
            assert np.array_equal(asked.actions(), actions)
            envs.rows.step(actions)
            ended = envs.rows.output.terminated
        last[half : half + n] = envs.rows.output.qoi
    assert last == pytest.approx([outcome(reached, i).qoi for i in range(2 * n)])


def test_the_online_optimum_is_an_expert_of_interruptions() -> None:
    family = Interruption(t_min=3, t_max=14, law="uniform", value=V)
    env = SenderEnv(family, 2)
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

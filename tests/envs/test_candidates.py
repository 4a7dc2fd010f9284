"""Ordered candidates against a slow reference model: order, decisions, masks and every number observed."""

import itertools
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from refusal_cases import refuse

from bufgym import oracle, policies
from bufgym.envs import SenderEnv, SenderVectorEnv, expert
from bufgym.envs.sub_envs import SubEnvs
from bufgym.jit import named
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.observe.candidates import take_logarithms
from bufgym.oracle.hindsight import Hindsight
from bufgym.scenario import Episode, Interruption, Uplink, messages
from bufgym.scenario.numbered import draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.sim.rollout import python_arrival, python_view
from bufgym.traces import Trace, drive_motion

kernels = pytest.mark.kernels
FADING = (Trace.steps([(1.0, 2_000_000), (1.5, 60_000)]),)
MOVING: dict[str, Any] = {
    "traces": FADING,
    "motion": (drive_motion(3, 30),),
    "rate_hz": 20,
    "value": qoi.saturating(0.2),
}
EQUAL = Uplink(**MOVING, duration_s=8.0)
JPEG = Uplink(**MOVING, duration_s=8.0, size_cv=0.7, jitter=0.5)


def log(a: float, b: float, shift: float = 0.0) -> float:
    """The logarithm of a / b plus ``shift``, within -3 to 3; ``shift`` where both are 0."""
    if a <= 0 and b <= 0:
        return 0.0
    if a <= 0 or b <= 0:
        return -3.0 if a <= 0 else 3.0
    return min(max(math.log(a / b) + shift, -3.0), 3.0)


def reference(sub_envs: SubEnvs, i: int, k: int) -> tuple[list[int], list[float]]:
    """What row ``i`` shows: the slot action of each action, and every number observed, written down from the text."""
    batch = named(sub_envs.senders.batch)
    buffer, arrival = python_view(batch, i), python_arrival(batch, i)
    s, L = len(buffer.slots), sub_envs.capacity
    queue = [*buffer.slots, arrival]
    x = [buffer.dequeued_x, *(message.x for message in queue)]
    step = x[-1] - buffer.previous_x
    before = [b - a for a, b in itertools.pairwise(x)]
    after = [*before[1:], step]
    mean = sum(message.size_bytes for message in queue) / (s + 1)
    cost = [(a + b) * mean / message.size_bytes for a, b, message in zip(before, after, queue, strict=True)]
    idle = s == 0 and buffer.busy == 0
    could = range(s) if buffer.evictions or idle else range(s + 1)
    cheapest = sorted(could, key=lambda j: (round(cost[j], 9), j))[:k]
    order = [*cheapest, *[None] * (k - len(cheapest)), 0 if s else None]
    room = s < L and buffer.backlog_bytes + arrival.size_bytes <= buffer.max_bytes
    none = (L + 1 if room else L) if order[0] is None else None
    slots = [none if j is None else L if j == s else j for j in (order[0] if j is None else j for j in order)]
    if sub_envs.options.asked_at == "arrival":
        slots = [L + 1 if room else slots[0], *slots]
    e = (x[-1] - x[0]) / (L + 1)
    columns = []
    for j in order:
        if j is None:
            columns.append([0.0] * 6)
            continue
        flags = [2 * (j + 1) / (s + 1) - 1, float(j == s), float(j == 0)]
        columns.append([*flags, log(cost[j], 2 * e), log(before[j], e), log(after[j], e)])
    short, medium, rate = (1e-6 * getattr(buffer, f"{n}_rate_bytes_per_s") for n in ("short", "medium", "long"))
    period, size = max(buffer.period_us, 1.0), arrival.size_bytes
    gain = qoi_of(sub_envs, e)
    bend = 2 * (2 * gain - qoi_of(sub_envs, 2 * e)) / gain - 1 if gain > 0 else -1.0
    context = [
        log(buffer.left_bytes, short * period),
        log(short, rate),
        log(medium, rate),
        log(rate * period, size, 2.0),
        log(step, e, 1.0),
        log(rate * (arrival.arrival_us - buffer.dequeued_arrival_us), (L + 1) * size),
        log(rate * buffer.stalled_us, size),
        bend,
        2 * s / L - 1,
    ]
    return slots, [*np.array(columns).T.ravel().tolist(), *context]


def qoi_of(sub_envs: SubEnvs, distance: float) -> float:
    """V of a distance."""
    return float(sub_envs.senders.value.information(np.array([0.0, distance])) - 1)


def batch_of(scenario: Any, n: int, **options: Any) -> SenderVectorEnv:
    return SenderVectorEnv(n, scenario, autoreset_mode="SameStep", **options)


@kernels
@pytest.mark.parametrize("asks", ["overflow", "arrival"])
@pytest.mark.parametrize(("scenario", "more"), [(EQUAL, {}), (JPEG, {}), (JPEG, {"max_bytes": 500_000})])
def test_order_and_numbers_are_those_of_the_reference_model(scenario: Any, more: dict[str, Any], asks: str) -> None:
    rng, missing = np.random.default_rng(0), 0
    for L, k in ((1, 2), (4, 1), (5, 3)):
        envs = batch_of(scenario, 2, capacity=L, candidates=k, decide_at=asks, **more)
        seen, info = envs.reset(seed=L)
        for _ in range(60):
            for i in np.flatnonzero(envs.sub_envs.senders.batch.senders["waiting"] == 1).tolist():
                slots, numbers = reference(envs.sub_envs, i, k)
                assert info["slots"][i].tolist() == slots
                assert seen[i] == pytest.approx(numbers, abs=2e-6)
                missing += int((info["action_mask"][i] == 0).sum())
            seen, _, _, _, info = envs.step(rng.integers(envs.single_action_space.n, size=2))
    assert (missing > 0) == (asks == "arrival" or bool(more))


def test_a_queue_by_hand() -> None:
    """L = 3, x = 0 has left; 1, 4, 5 wait and 7 comes. Dropping 1 leaves 4, 4 leaves 4, 5 leaves 3, 7 leaves 2 + 2.

    So slot 2 is the cheapest; of the others, which are equal, slot 0 is the oldest and the second.
    """
    x = np.array([0.0, 1, 4, 5, 7, 9])
    arrivals = messages(np.arange(6) * 1_000_000, 100, x=x)
    episode = Episode(arrivals, Link(Trace.steps([(100.0, 1.0)])))
    env = SenderEnv(Interruption(t_max=20), 3)
    seen, info = env.reset(options={"episode": episode})
    assert info["slots"].tolist() == [2, 0, 0] and info["action_mask"].tolist() == [1, 1, 1]
    place, newcomer, head, merged, before, after = seen[:18].reshape(6, 3)
    e = 7 / 4
    assert place.tolist() == [0.5, -0.5, -0.5] and newcomer.tolist() == [0, 0, 0] and head.tolist() == [0, 1, 1]
    assert merged == pytest.approx(np.log(np.array([3, 4, 4]) / (2 * e)), abs=1e-6)
    assert before == pytest.approx(np.log(np.array([1, 1, 1]) / e), abs=1e-6)
    assert after == pytest.approx(np.log(np.array([2, 3, 3]) / e), abs=1e-6)
    env.step(0)  # x = 5 goes
    batch = named(env.sub_envs.senders.batch)
    first = batch.senders[0].first
    assert batch.slots.x[0, first : first + 3].tolist() == [1, 4, 7]


def test_no_action_leaves_the_link_idle() -> None:
    """A message a second over a link that takes .5 s for each: every action accepts all of them."""
    arrivals = messages(np.arange(6) * 1_000_000, 100, x=np.arange(6.0))
    env = SenderEnv(Interruption(t_max=20), 3, decide_at="arrival")
    for action in range(4):
        _, info = env.reset(options={"episode": Episode(arrivals, Link(Trace.steps([(100.0, 200.0)])))})
        ended = False
        while not ended:
            assert info["slots"].tolist() == [4, 4, 4, 4] and info["action_mask"].tolist() == [1, 0, 0, 0]
            _, _, ended, _, info = env.step(action)
        assert named(env.sub_envs.senders.batch).senders[0].dequeued == 6


@kernels
def test_actions_do_what_the_slot_actions_do() -> None:
    """Two environments in the same states: one takes candidates, the other the slots that they stand for."""
    for asks in ("overflow", "arrival"):
        few, slots = (batch_of(JPEG, 4, capacity=5, decide_at=asks, actions=a) for a in ("candidates", "slots"))
        info = few.reset(seed=0)[1]
        slots.reset(seed=0)
        rng = np.random.default_rng(1)
        for _ in range(100):
            actions = rng.integers(few.single_action_space.n, size=4)
            meant = info["slots"][np.arange(4), actions]
            _, one, ended, _, info = few.step(actions)
            _, other, ended_too, _, _ = slots.step(meant)
            assert np.array_equal(one, other) and np.array_equal(ended, ended_too)


def test_the_defaults_of_each_kind_of_environment() -> None:
    env = gym.make("bufgym/Uplink-v1")
    assert (env.action_space, env.observation_space.shape) == (gym.spaces.Discrete(3), (27,))
    assert env.unwrapped.sub_envs.senders.decide_at == "overflow"
    slots = gym.make("bufgym/Uplink-v1", actions="slots")
    assert (slots.action_space, slots.unwrapped.sub_envs.senders.decide_at) == (gym.spaces.Discrete(10), "arrival")
    assert gym.make("bufgym/Topics-v0").action_space == gym.spaces.Discrete(34)
    named = gym.make("bufgym/Uplink-v1", candidates=3, decide_at="arrival", observation="dict")
    assert named.action_space == gym.spaces.Discrete(5) and named.observation_space["candidate_merged"].shape == (4,)


def test_a_batch_has_the_rows_of_single_environments() -> None:
    envs = batch_of(JPEG, 3, capacity=4)
    seen, info = envs.reset(seed=5)
    for i in range(3):
        env = SenderEnv(JPEG, 4)
        row, own = env.reset(seed=5 + i)
        assert np.array_equal(seen[i], row) and np.array_equal(info["slots"][i], own["slots"])


@kernels
def test_logarithms_are_right_to_a_millionth() -> None:
    ratios = np.exp(np.linspace(-3, 3, 999)).astype(np.float32)
    logarithms = ratios.copy()
    take_logarithms(logarithms)
    assert logarithms == pytest.approx(np.log(ratios.astype(np.float64)), abs=1e-6)
    exact = np.ones(3, np.float32)
    take_logarithms(exact)
    assert exact.tolist() == [0, 0, 0]


def test_a_rule_plays_among_candidates() -> None:
    """``min-motion-gap`` is the cheapest candidate; as an expert it reaches in the environment what it has in a run."""
    envs = batch_of(EQUAL, 3, capacity=5, info="mask")
    episodes = [draw(EQUAL, seed) for seed in range(3)]
    envs.reset(options={"episodes": episodes})
    rule, qoi_at_end = expert.policy(envs, "min-motion-gap"), np.zeros(3)
    over = np.zeros(3, np.bool_)
    while not over.all():
        actions = rule.actions()
        assert (actions == 0).all()
        _, _, ended, _, info = envs.step(actions)
        if ended.any():
            qoi_at_end[ended & ~over] = info["final_info"]["qoi"][ended & ~over]
            over |= ended
    senders = run(policies.get("min-motion-gap"), episodes, 5, EQUAL.value)
    assert qoi_at_end == pytest.approx([outcome(senders, i).qoi for i in range(3)], abs=1e-12)


test_wrong_use_is_named = [
    (lambda: SenderEnv("lte", candidates=0), "candidates = 0: must be a whole number from 1 to 64"),
    (lambda: SenderEnv("lte", fields="rank"), "fields = 'rank': must be a list of names"),
    (lambda: gym.make("bufgym/Topics-v0", actions="candidates"), "known for one queue on a link of its own"),
    (lambda: SenderEnv("lte", size_cv=0.5, reward="regret").reset(seed=0), "for equal sizes only"),
    (lambda: _begun().step(3), r"must be a whole number in 0\.\.2 \(the 2 cheapest candidates and the head\)"),
]


def _begun() -> SenderEnv:
    env = SenderEnv(EQUAL)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(("use", "rule"), test_wrong_use_is_named)
def test_wrong_use_is_refused(use: Any, rule: str) -> None:
    refuse(rule, use)


SHORT = Uplink(**MOVING | {"value": qoi.exponential(0.4)}, duration_s=5.0)


@pytest.mark.parametrize("asks", ["overflow", "arrival"])
@pytest.mark.parametrize("actions", ["candidates", "slots"])
@pytest.mark.parametrize("n", [6, pytest.param(250, marks=pytest.mark.nightly)])
def test_regrets_of_an_episode_sum_to_what_it_lacks(asks: str, actions: str, n: int) -> None:
    """H less the clairvoyant's H of the episode, which ``bound`` tells too, wherever it is asked first.

    At arrivals that is the best attainable at the first decision; at overflow something may be lost before it. Nightly
    with a thousand episodes.
    """
    envs = batch_of(SHORT, n, capacity=4, decide_at=asks, actions=actions, reward="regret", info="mask")
    episodes = [draw(SHORT, seed) for seed in range(n)]
    info = envs.reset(options={"episodes": episodes})[1]
    start = np.nanmax(Hindsight(envs.sub_envs.senders, "a test").values(), axis=1)  # of all decisions, not of a few
    best = np.array([oracle.clairvoyant(e, 4, SHORT.value).qoi for e in episodes])
    assert (start < best + 1e-9).all() and (start < best - 1e-6).any() == (asks == "overflow")
    rng, total, over = np.random.default_rng(0), np.zeros(n), np.zeros(n, np.bool_)
    reached = np.zeros(n)
    while not over.all():
        chosen = (rng.random(info["action_mask"].shape) * info["action_mask"]).argmax(axis=1)
        _, reward, ended, _, info = envs.step(chosen)
        total[~over] += reward[~over]
        assert (reward[~over] < 1e-9).all()
        if ended.any():
            reached[ended & ~over] = info["final_info"]["qoi"][ended & ~over]
            over |= ended
    assert total == pytest.approx(reached - best, abs=1e-9)


@kernels
def test_regret_is_the_same_alone_and_in_a_batch() -> None:
    envs, env = batch_of(SHORT, 2, capacity=3, reward="regret"), SenderEnv(SHORT, 3, reward={"regret": 1.0})
    envs.reset(seed=0)
    env.reset(seed=1)
    for action in (0, 1, 2, 0, 2, 1) * 5:
        both = envs.step(np.array([0, action]))
        alone = env.step(action)
        assert both[1][1] == alone[1]
        assert both[4]["reward_terms"]["regret"][1] == alone[4]["reward_terms"]["regret"] == alone[1]


@kernels
def test_where_no_message_has_room_nothing_is_given_up() -> None:
    """B is a byte short of a message, so nothing is sent whatever one does: V* is 0 from the start."""
    env = SenderEnv(SHORT, 3, reward="regret", max_bytes=SHORT.size_bytes - 1, decide_at="arrival")
    env.reset(seed=0)
    ended, rewards = False, []
    while not ended:
        _, reward, ended, *_ = env.step(0)
        rewards.append(reward)
    assert not any(rewards)


def test_an_episode_without_a_decision_gives_up_nothing() -> None:
    episode = Episode(messages(np.arange(4) * 1_000_000, 10), Link(Trace.steps([(100.0, 1000.0)])))
    env = SenderEnv(Interruption(t_max=20), 3, reward="regret")
    env.reset(options={"episode": episode})
    _, reward, ended, _, info = env.step(0)
    assert ended and reward == 0.0 and info["delivered"] == 4


@kernels
@pytest.mark.parametrize("actions", ["candidates", "slots"])
@pytest.mark.parametrize(
    ("name", "more"),
    [("Uplink-v1", {"duration_s": 10.0}), ("Interruption-v1", {}), ("Suite-v1", {"suite": "generated-v1"})],
)
def test_rewards_and_the_bound_have_one_clairvoyant(name: str, more: dict[str, Any], actions: str) -> None:
    """Default environments: ``regret`` sums to H less the H that ``bound`` names, the first step's loss included."""
    env = gym.make(f"bufgym/{name}", reward="regret", bound=True, actions=actions, **more)
    rng = np.random.default_rng(0)
    for seed in range(2):
        _, info = env.reset(seed=seed)
        total, ended = 0.0, False
        while not ended:
            mask = info["action_mask"].astype(np.int8)
            _, reward, ended, _, info = env.step(int(rng.choice(np.flatnonzero(mask))))
            total += float(reward)
        assert info["certified"] and total == pytest.approx(info["qoi"] - info["clairvoyant"], abs=1e-9)

"""The cell: sharing worked by hand, against the twins, and the one robot that must not notice that it is a cell."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import naive
import numpy as np
import pytest
from cases import (
    ANYTHING,
    VALUES,
    cases,
    decide_anything,
    drawn_messages,
    log,
    order,
    same,
    trace,
    traces,
    twin_log,
    twin_messages,
)
from hypothesis import given
from hypothesis import strategies as st
from naive_cell import Cell

from bufgym import policies
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, HOLD
from bufgym.model.link import Link
from bufgym.scenario import FleetEpisode, FleetScenario, Streams, messages
from bufgym.sim import run
from bufgym.sim.cell import run_fleet
from bufgym.sim.metrics import outcome

V = qoi.exponential(0.5)
US = trace([(0, 0), (1_000_000, 1_000_000)], "loop")
"""1 byte a microsecond."""


def accept(buffer, arrival, memory):
    return ACCEPT


def hesitant(buffer, memory):
    """A scheduler that lets every third chance to send pass."""
    memory[0] += 1
    return HOLD if memory[0] % 3 == 0 else 0


ACCEPTS = policies.Policy("test-accept", accept, compile=True)
HESITANT = policies.Policy("test-hesitant", decide_anything, on_send=hesitant, memory={"asked": 0.0}, compile=True)
POLICIES = [
    p for p in (*map(policies.get, policies.names()), ANYTHING, HESITANT) if p.privileged is None and not any(p.work)
]


def cell(*robots, trace=US, policy=ACCEPTS, capacity=8):
    """A fleet after robots met their messages, each a list of (arrival us, bytes)."""
    arrivals = [messages(*np.array(mine, np.int64).T) for mine in robots]
    return run_fleet(policy, [FleetEpisode(tuple(arrivals), Link(trace))], capacity, V)


def transmitted(fleet):
    """{sequence number: when it had crossed}, a dictionary for each robot."""
    return [log(fleet.senders, i)["transmitted_us"] for i in range(len(fleet.senders))]


# --- by hand ---------------------------------------------------------------------------------------------------------


def test_two_that_send_at_once_take_twice_as_long():
    assert transmitted(cell([(0, 1_000)], [(0, 1_000)])) == [{0: 2_000}, {0: 2_000}]


def test_who_joins_later_and_who_leaves_earlier():
    # A is alone until 500 and has 500 bytes left; then each gets half a byte a microsecond: A crosses at 1500.
    # B has had 500 by then and the link for itself: its other 500 bytes cross at 2000.
    assert transmitted(cell([(0, 1_000)], [(500, 1_000)])) == [{0: 1_500}, {0: 2_000}]


def test_a_successor_shares_from_the_byte_on_where_the_message_before_it_ended():
    # A: 100 and then 100; B: 300. Both get 100 by 200; A's second has its 100 by 400, B its second 100 too; B alone
    # needs 100 more: 500.
    fleet = cell([(0, 100), (0, 100)], [(0, 300)])
    assert transmitted(fleet) == [{0: 200, 1: 400}, {0: 500}]
    assert log(fleet.senders, 0)["dequeued_us"] == {0: 0, 1: 200}


def test_bytes_that_can_not_be_divided_are_kept_for_all():
    # By 3 us the link has carried 3 bytes: A and B have one each, one is left over. C joins; the three of them need
    # 3 x 4 more for A and B to have their 5: byte 2 + 12 = 14. C has had 4 of its 10 and ends at byte 20 = 5 + 5 + 10.
    assert transmitted(cell([(0, 5)], [(0, 5)], [(3, 10)])) == [{0: 14}, {0: 14}, {0: 20}]


def test_an_idle_cell_keeps_nothing():
    # A is done at 10; what the link could have carried until 100 is gone. B and A's second start at 100 together.
    assert transmitted(cell([(0, 10), (100, 10)], [(100, 10)])) == [{0: 10, 1: 120}, {0: 120}]


def test_what_crosses_at_the_time_of_an_arrival_has_left_before_it():
    # L = 1. Both first messages cross at 1000; A's second is taken then, so its third, which arrives then, finds room.
    newest = policies.get("drop-newest")
    fleet = cell([(0, 500), (0, 1), (1_000, 1)], [(0, 500)], policy=newest, capacity=1)
    assert log(fleet.senders, 0)["dropped_us"] == {}
    fleet = cell([(0, 500), (0, 1), (999, 1)], [(0, 500)], policy=newest, capacity=1)
    assert log(fleet.senders, 0)["dropped_us"] == {2: 999}


def test_a_link_that_stops_leaves_them_all_in_transmission():
    fleet = cell([(0, 600), (1, 10)], [(0, 600)], trace=trace([(0, 0), (1_000, 1_000)], "stop"))
    assert transmitted(fleet) == [{}, {}]
    told = [outcome(fleet.senders, i) for i in fleet.rows(0)]
    assert [(o.in_transmission, o.buffered, o.qoi) for o in told] == [(1, 1, 0.0), (1, 0, 0.0)]


def test_a_robot_sees_what_is_left_of_its_own_message():
    seen = {}

    def look(buffer, arrival, memory):
        seen[buffer.now_us] = (buffer.busy, buffer.left_bytes, buffer.left_fraction)
        return ACCEPT

    # A's 1000 bytes: all of the link until 500, half of it from then on: 750 us after the start 375 bytes are left,
    # at 1250 us 125.
    looking = policies.Policy("test-look", look)
    cell([(0, 1_000), (750, 1), (1_250, 1)], [(500, 10_000)], policy=looking)
    assert seen[750] == (1, 375, 0.375)
    assert seen[1_250] == (1, 125, 0.125)
    assert seen[0] == seen[500] == (0, 0, 0.0)


# --- one robot is a sender -------------------------------------------------------------------------------------------


@given(cases(), VALUES, st.sampled_from(POLICIES))
def test_one_robot_is_a_sender_bit_for_bit(case, v, policy):
    episode = FleetEpisode((case.episode.arrivals,), case.episode.link)
    limits = {"max_bytes": case.max_bytes, "decide_at": case.decide_at}
    fleet = run_fleet(policy, [episode], case.capacity, v, **limits)
    alone = run(policy, [episode.episode(0)], case.capacity, v, **limits)
    assert same(fleet.senders, alone)


@pytest.mark.parametrize("policy", POLICIES, ids=lambda policy: policy.name)
def test_one_robot_is_a_sender_under_every_policy(policy):
    made, (episode, _) = drawn_episodes(1, size_bytes=700_000)
    alone = run(policy, [episode.episode(0)], 4, made.value)
    assert same(run_fleet(policy, [episode], 4, made.value).senders, alone)
    assert log(alone)["dropped_us"] or policy.unbounded


@given(cases(), st.integers(2, 5), st.sampled_from(POLICIES))
def test_robots_that_are_alike_fare_as_one_on_its_share(case, n, policy):
    # N times the capacity, N times the demand: at the same times, to the microsecond (on links that have carried whole
    # bytes at every whole microsecond: a link that begins anew in the middle of a byte drops the rest of that byte).
    link = case.episode.link
    rates = [(t - s, -(-(b - a) // (t - s))) for (s, a), (t, b) in itertools.pairwise(case.knots)]

    def links(robots):
        knots = [(0, 0)]
        for us, rate in rates:
            knots.append((knots[-1][0] + us, knots[-1][1] + us * rate * robots))
        return Link(trace(knots, link.trace.after), link.offset_us, link.propagation_us)

    fleet = run_fleet(policy, [FleetEpisode((case.episode.arrivals,) * n, links(n))], case.capacity, V)
    alone = run(policy, [FleetEpisode((case.episode.arrivals,), links(1)).episode(0)], case.capacity, V)
    for i in range(n):
        assert log(fleet.senders, i) == log(alone)
        assert order(fleet.senders, i) == order(alone)


# --- the twins -------------------------------------------------------------------------------------------------------


@st.composite
def cells(draw, idle=True):
    """(episode of 1..4 robots, its knots, L, B); ``idle``: arrivals may come so late that the cell falls idle."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    knots, after = draw(traces())
    link = Link(trace(knots, after), draw(st.integers(0, 3 * knots[-1][0])), draw(st.integers(0, 30_000)))
    together = draw(st.booleans())
    robots, n = [], draw(st.integers(1, 15))
    largest = draw(st.sampled_from([2, 40, 4_000]))
    for _ in range(draw(st.integers(1, 4))):
        arrivals = drawn_messages(rng, n, largest, robots[0]["arrival_us"] if together and robots else None)
        robots.append(arrivals)
        n = n if together else int(rng.integers(1, 16))
    max_bytes = draw(st.one_of(st.none(), st.integers(1_000, 15_000)))
    return FleetEpisode(tuple(robots), link), knots, draw(st.integers(1, 6)), max_bytes


def twin(episode, knots, policy, capacity, max_bytes=None, decide_at="arrival", whole=True):
    link = naive.Link(knots, episode.link.trace.after, episode.link.offset_us)
    cell = Cell(link, [policy() for _ in episode.arrivals], capacity, max_bytes, decide_at, whole)
    return cell.run([twin_messages(arrivals) for arrivals in episode.arrivals])


class TwinAnything(naive.Policy):
    def decide(self, queue, message, capacity, last_dequeued, previous):
        drawn = int(message["uniform"] * (capacity + 4)) - 2
        return drawn if drawn >= 0 else [naive.ACCEPT, naive.REJECT][drawn + 2]


class TwinAccept(naive.Policy):
    def decide(self, queue, message, capacity, last_dequeued, previous):
        return naive.ACCEPT


class TwinLook(naive.Policy):
    """Accepts, and notes how much of the message in transmission is left."""

    def decide(self, queue, message, capacity, last_dequeued, previous):
        self.noted = [*getattr(self, "noted", []), self.sender.left_bytes(message["us"])]
        return naive.ACCEPT


@given(cells(), st.sampled_from(["arrival", "overflow"]))
def test_the_whole_byte_twin_agrees_exactly(drawn, decide_at):
    episode, knots, capacity, max_bytes = drawn
    fleet = run_fleet(ANYTHING, [episode], capacity, V, max_bytes=max_bytes, decide_at=decide_at)
    slow = twin(episode, knots, TwinAnything, capacity, max_bytes, decide_at)
    for i, robot in enumerate(slow.robots):
        assert log(fleet.senders, i) == twin_log(robot)
        assert order(fleet.senders, i) == robot.order
        told = outcome(fleet.senders, i)
        assert told.arrived == told.delivered + told.in_transmission + told.buffered + told.dropped
        assert told.qoi == pytest.approx(naive.information(V, [episode.arrivals[i]["x"][k] for k in robot.order]))


@given(cells())
def test_processor_sharing_itself_within_a_few_bytes(drawn):
    # Fractions of a byte are shared too. Whole bytes give those who are busy at a start less than a byte too little
    # each, and who starts less than a byte too much: less than 2 in sum for each start, wherever they move later. And
    # a message that ends a microsecond sooner or later may leave an idle link another microsecond's bytes.
    episode, knots, _, _ = drawn
    fleet = run_fleet(ACCEPTS, [episode], 100, V)
    slow = twin(episode, knots, TwinAccept, 100, whole=False)
    per_us = max(math.ceil((b - a) / (t - s)) for (s, a), (t, b) in itertools.pairwise(knots))
    bound = (2 + per_us) * slow.starts + len(slow.robots) + 2 * per_us
    for i, robot in enumerate(slow.robots):
        ours = log(fleet.senders, i)["transmitted_us"]
        # By position, not by time: an outage stretches the last byte to any length.
        for k in ours.keys() & robot.transmitted.keys():
            assert abs(slow.link.bytes_by(ours[k]) - slow.link.bytes_by(robot.transmitted[k])) <= bound
        assert len(ours.keys() ^ robot.transmitted.keys()) <= 1  # the last one may miss the end of a link that stops
        assert order(fleet.senders, i) == sorted(ours)


@given(cells())
def test_what_each_robot_sees_of_its_message_is_the_twins(drawn):
    episode, knots, _, _ = drawn
    seen = {}

    def look(buffer, arrival, memory):
        seen.setdefault(int(memory[0]), []).append(buffer.left_bytes)
        return ACCEPT

    robots = episode.robots
    looking = policies.Policy("test-look", look)
    run_fleet(looking, [episode], 100, V, memory=np.arange(robots, dtype=np.float64)[:, None])
    slow = twin(episode, knots, TwinLook, 100)
    for i, robot in enumerate(slow.robots):
        # A message that follows another counts as whole until the microsecond in which it was taken is over.
        twins = robot.policy.noted
        for k, (mine, its) in enumerate(zip(seen[i], twins, strict=True)):
            now = int(episode.arrivals[i]["arrival_us"][k])
            dequeued = [seq for seq, us in robot.dequeued.items() if us == now]
            whole = max((int(episode.arrivals[i]["size_bytes"][seq]) for seq in dequeued), default=-1)
            assert mine in (its, whole)


# --- policies and batches --------------------------------------------------------------------------------------------


def drawn_episodes(robots, count=2, **parameters):
    made = FleetScenario.of(robots, "lte", duration_s=3.0, size_cv=0.5, **parameters)
    return made, [made.draw(Streams.seeded(k)) for k in range(count)]


@pytest.mark.parametrize("name", ["afr", "drop-oldest", "codel"])
def test_a_python_policy_does_what_the_compiled_one_does(name):
    made, episodes = drawn_episodes(3)
    compiled = policies.get(name)
    python = replace(compiled, name="test-python", compile=False)
    assert same(
        run_fleet(compiled, episodes, 4, made.value).senders, run_fleet(python, episodes, 4, made.value).senders
    )


@pytest.mark.parametrize("hook", ["on_arrival", "on_dequeue", "on_send"])
@pytest.mark.parametrize("given", [None, "1", 0.5])
def test_what_is_no_whole_number_is_no_answer(hook, given):
    made, episodes = drawn_episodes(2)
    odd = policies.Policy("odd", **{"on_arrival": accept, hook: lambda *_: given})
    complaint = rf"policy odd: {hook} returned {given!r}: must be a whole number"
    with pytest.raises(BufgymError, match=complaint):
        run_fleet(odd, episodes, 4, made.value)
    with pytest.raises(BufgymError, match=complaint):
        run(odd, [episodes[0].episode(0)], 4, made.value)


def test_cells_of_a_batch_know_nothing_of_each_other():
    made, episodes = drawn_episodes(3)
    both = run_fleet(policies.get("afr"), episodes, 4, made.value)
    for c, episode in enumerate(episodes):
        alone = run_fleet(policies.get("afr"), [episode], 4, made.value)
        for i, row in enumerate(both.rows(c)):
            assert log(both.senders, row) == log(alone.senders, i)
    # and a fleet can be loaded again
    for c, episode in enumerate(reversed(episodes)):
        both.load(c, episode)
    both.run(policies.get("afr"))
    assert log(both.senders, 0) == log(run_fleet(policies.get("afr"), episodes[1:], 4, made.value).senders, 0)


def test_policies_remember_each_robot_for_itself():
    # AFR's index moves with the buffer that it is about: robots with different streams part, those alike do not.
    made, (episode, _) = drawn_episodes(2, size_bytes=900_000)
    twins = FleetEpisode((episode.arrivals[0], episode.arrivals[0], episode.arrivals[1]), episode.link)
    fleet = run_fleet(policies.get("afr"), [twins], 4, made.value)
    assert log(fleet.senders, 0) == log(fleet.senders, 1) != log(fleet.senders, 2)

"""The cell: sharing by hand, against the reference models, and the one robot that must not notice that it is a cell."""

import itertools
import math
from dataclasses import replace

import cases
import naive
import naive_policies
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive_cell import Cell
from refusal_cases import refuse

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, HOLD
from bufgym.model.link import Link
from bufgym.scenario import FleetEpisode, FleetScenario, Streams
from bufgym.sim import run
from bufgym.sim.cell import run_fleet
from bufgym.sim.metrics import outcome

kernels = pytest.mark.kernels
V = qoi.exponential(0.5)


def accept(buffer, arrival, memory):
    return ACCEPT


def hesitant(buffer, memory):
    """A scheduler that lets every third chance to send pass."""
    memory[0] += 1
    return HOLD if memory[0] % 3 == 0 else 0


ACCEPTS = policies.Policy("test-accept", accept, compile=True)
HESITANT = replace(cases.ANYTHING, name="test-hesitant", on_send=hesitant, memory={"asked": 0.0})
POLICIES = [p for p in (*map(policies.get, policies.names()), HESITANT) if p.privileged is None and not any(p.work)]


@kernels
@given(cases.cases(max_messages=25), cases.VALUES, st.sampled_from(POLICIES))
def test_one_robot_is_a_sender_bit_for_bit(case, v, policy):
    episode = FleetEpisode((case.episode.arrivals,), case.episode.link)
    limits = {"max_bytes": case.max_bytes, "decide_at": case.decide_at}
    fleet = run_fleet(policy, [episode], case.capacity, v, **limits)
    assert cases.same(fleet.senders, run(policy, [episode.episode(0)], case.capacity, v, **limits))


@st.composite
def cells(draw):
    """(episode of 1..4 robots, its knots, L, B); arrivals may come so late that the cell falls idle."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    knots, after = draw(cases.traces())
    link = Link(cases.trace(knots, after), draw(st.integers(0, 3 * knots[-1][0])), draw(st.integers(0, 30_000)))
    together = draw(st.booleans())
    robots, n = [], draw(st.integers(1, 15))
    largest = draw(st.sampled_from([2, 40, 4_000]))
    for _ in range(draw(st.integers(1, 4))):
        robots.append(cases.drawn_messages(rng, n, largest, robots[0]["arrival_us"] if together and robots else None))
        n = n if together else int(rng.integers(1, 16))
    max_bytes = draw(st.one_of(st.none(), st.integers(1_000, 15_000)))
    return FleetEpisode(tuple(robots), link), knots, draw(st.integers(1, 6)), max_bytes


def reference(episode, knots, policy, capacity, max_bytes=None, decide_at="arrival", whole=True):
    link = naive.Link(knots, episode.link.trace.after, episode.link.offset_us)
    cell = Cell(link, [policy() for _ in episode.arrivals], capacity, max_bytes, decide_at, whole)
    return cell.run([cases.reference_messages(arrivals) for arrivals in episode.arrivals])


class ReferenceAccept(naive.Policy):
    def decide(self, queue, newcomer):
        return naive.ACCEPT


class ReferenceLook(naive_policies.Anything):
    """Decides at random, and notes how much of the message in transmission is left."""

    def __init__(self):
        self.noted = []

    def decide(self, queue, newcomer):
        self.noted.append(self.sender.left_bytes())
        return super().decide(queue, newcomer)


@kernels
@given(cells(), st.sampled_from(["arrival", "overflow"]))
def test_the_whole_byte_reference_agrees_exactly(drawn, decide_at):
    episode, knots, capacity, max_bytes = drawn
    seen = [[] for _ in episode.arrivals]

    def look(buffer, arrival, memory):
        seen[int(memory[0])].append((buffer.now_us, buffer.left_bytes))
        return cases.decide_anything(buffer, arrival, memory)

    limits = {"max_bytes": max_bytes, "decide_at": decide_at}
    memory = np.arange(episode.robots, dtype=np.float64)[:, None]
    fleet = run_fleet(policies.Policy("test-look", look), [episode], capacity, V, memory=memory, **limits)
    for i, robot in enumerate(reference(episode, knots, ReferenceLook, capacity, max_bytes, decide_at).robots):
        assert cases.log(fleet.senders, i) == cases.reference_log(robot)
        assert cases.order(fleet.senders, i) == robot.order
        result = outcome(fleet.senders, i)
        assert result.arrived == result.delivered + result.in_transmission + result.buffered + result.dropped
        assert result.qoi == pytest.approx(naive.information(V, [episode.arrivals[i]["x"][k] for k in robot.order]))
        for (now_us, left), its in zip(seen[i], robot.policy.noted, strict=True):
            # A message that follows another counts as whole until the microsecond in which it was taken is over.
            whole = [int(episode.arrivals[i]["size_bytes"][seq]) for seq, us in robot.dequeued.items() if us == now_us]
            assert left in (its, max(whole, default=-1))


@kernels
@given(cells())
def test_processor_sharing_itself_within_a_few_bytes(drawn):
    # Fractions of a byte are shared too. Whole bytes give those who are busy at a start less than a byte too little
    # each, and who starts less than a byte too much: less than 2 in sum for each start, wherever they move later. And
    # a message that ends a microsecond sooner or later may leave an idle link another microsecond's bytes.
    episode, knots, _, _ = drawn
    fleet = run_fleet(ACCEPTS, [episode], 100, V)
    slow = reference(episode, knots, ReferenceAccept, 100, whole=False)
    per_us = max(math.ceil((b - a) / (t - s)) for (s, a), (t, b) in itertools.pairwise(knots))
    bound = (2 + per_us) * slow.starts + len(slow.robots) + 2 * per_us
    for i, robot in enumerate(slow.robots):
        ours = cases.log(fleet.senders, i)["transmitted_us"]
        # By position, not by time: an outage stretches the last byte to any length.
        for k in ours.keys() & robot.transmitted.keys():
            assert abs(slow.link.bytes_by(ours[k]) - slow.link.bytes_by(robot.transmitted[k])) <= bound
        assert len(ours.keys() ^ robot.transmitted.keys()) <= 1  # the last one may miss the end of a link that stops
        assert cases.order(fleet.senders, i) == sorted(ours)


def drawn_episodes(robots, count=2, **parameters):
    made = FleetScenario.of(robots, "lte", duration_s=3.0, size_cv=0.5, **parameters)
    return made, [made.draw(Streams.seeded(k)) for k in range(count)]


@pytest.mark.parametrize(("hook", "given"), [("on_arrival", None), ("on_dequeue", "1"), ("on_send", 0.5)])
def test_an_answer_must_be_a_whole_number(hook, given):
    made, episodes = drawn_episodes(2)
    odd = policies.Policy("odd", **{"on_arrival": accept, hook: lambda *_: given})
    one = episodes[0].episode(0)
    for play in (lambda: run_fleet(odd, episodes, 4, made.value), lambda: run(odd, [one], 4, made.value)):
        refuse(rf"policy odd: {hook} returned {given!r}: must be a whole number", play)


def test_cells_of_a_batch_know_nothing_of_each_other():
    made, episodes = drawn_episodes(3)
    afr = policies.get("afr")
    both = run_fleet(afr, episodes, 4, made.value)
    alone = [run_fleet(afr, [episode], 4, made.value) for episode in episodes]
    for again in (0, 1):  # and a fleet can be loaded again
        for c in range(2):
            for i, row in enumerate(both.rows(c)):
                assert cases.log(both.senders, row) == cases.log(alone[c ^ again].senders, i)
            both.load(c, episodes[1 - c])
        both.run(afr)

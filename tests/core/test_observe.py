"""What is observed: event by event against a reference model of the tables; each field in its bounds and documented."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import ANYTHING, VALUES, cases
from hypothesis import given
from topic_cases import CONTEXT_NAMES, REFERENCE_V, SLOT_NAMES, TopicCase, observed, topic_cases

from bufgym import policies
from bufgym.jit import named
from bufgym.model import observe
from bufgym.model.buffer import ACCEPT, UNLIMITED_BYTES
from bufgym.model.link import Link
from bufgym.model.observe import FIELDS, TOPIC_FIELDS, Field, declare
from bufgym.model.qoi import saturating
from bufgym.model.topics import Topic
from bufgym.policies import chains, rule_inputs
from bufgym.scenario import Episode, messages
from bufgym.sim import Senders
from bufgym.sim.decisions import decide
from bufgym.sim.rollout import python_view
from bufgym.sim.state import DECISION, END
from bufgym.sim.transition import next_event
from bufgym.traces import Trace


def per(g, r):
    """g / (g + r); 0 of nothing."""
    return float(g / (g + r)) if g > 0 else 0.0


class Reference:
    """The fields of one moment, from what the slow sender of ``naive_sender`` knows."""

    def __init__(self, case: TopicCase, sender, buffer) -> None:
        self.case, self.sender, self.buffer = case, sender, buffer
        self.topics = case.topics or (Topic("only"),)
        self.top = max(topic.share for topic in self.topics) or 1.0
        self.newcomer = sender.newcomer
        self.L = case.case.capacity

    def v(self, lane):
        return REFERENCE_V[self.topics[lane].value or self.case.v]

    def even(self, lane, field, last):
        """The even spacing of a topic: from what was sent last (until then: kept first) to its arrival ``last``.

        One queue: that of L messages.
        """
        if self.sender.one_queue:
            return (last - self.sender.reference()[field]) / (self.L + 1)
        sent, queued = self.sender.sent[lane], self.sender.queues[lane]
        if not sent and not queued:
            return 0.0
        begin = sent[-1] if sent else self.sender.origin[lane]
        return max(last - begin[field], 0) / (len(queued) + 1)

    def last(self, lane, field):
        """Of a topic's last arrival, the newcomer included."""
        if self.newcomer is not None and self.sender.lane(self.newcomer) == lane:
            return self.newcomer[field]
        arrived = self.sender.arrived[lane]
        return arrived[-1][field] if arrived else 0

    def gaps(self, m, field):
        """To what is kept before it on its topic, and to what follows; one more step where nothing does."""
        lane, s = self.sender.lane(m), self.sender
        if s.one_queue:
            return s.gaps(m, field)
        before = s.kept_before(m) or m
        arrived, later = s.arrived[lane], [q for q in s.queues[lane] if q["seq"] > m["seq"]]
        step = arrived[-1][field] - arrived[-2][field] if len(arrived) > 1 else 0
        if m is self.newcomer:
            after = m[field] - arrived[-1][field] if arrived else 0
        elif later:
            after = later[0][field] - m[field]
        elif self.newcomer is not None and self.newcomer["topic"] == lane:
            after = self.newcomer[field] - m[field]
        else:
            after = arrived[-1][field] - m[field] + step
        return m[field] - before[field], after

    def gain(self, m):
        """V of what its delivery adds, weighted; the first of a topic is the 1 in its H."""
        before = self.sender.kept_before(m)
        lane = self.sender.lane(m)
        return 0.0 if before is None else self.topics[lane].share * self.v(lane)(m["x"] - before["x"])

    def candidate(self, m, k):
        """All slot fields of message ``m`` at place ``k``; the newcomer comes after all that are queued."""
        s, lane, messages = self.sender, self.sender.lane(m), self.candidates()
        topic, v, queue = self.topics[lane], self.v(lane), s.queues[lane]
        (a_us, b_us), (a, b) = self.gaps(m, "us"), self.gaps(m, "x")
        even_us = self.even(lane, "us", self.last(lane, "us"))
        even_x = self.even(lane, "x", self.last(lane, "x"))
        lost = max(v(a) + v(b) - v(a + b), 0.0)
        if s.one_queue and k == 0 and not s.sent[0]:
            lost = 0.0  # the first message of all has no gap before it yet
        age = s.now - m["us"]
        gains = [self.gain(each) / self.top / each["bytes"] for each in messages]
        return {
            "occupied": 1.0,
            "rank": 1.0 if m is self.newcomer else (k + 1) / (len(s.slots()) + 1),
            "time_before": per(a_us, even_us),
            "time_merged": per(a_us + b_us, 2 * even_us),
            "motion_before": per(a, even_x),
            "motion_merged": per(a + b, 2 * even_x),
            "loss": lost * topic.share / self.top,
            "relative_loss": per(lost, max(2 * v(even_x) - v(2 * even_x), 1e-12)),
            "size": per(m["bytes"], np.mean([each["bytes"] for each in messages])),
            "priority": topic.priority / (max(each.priority for each in self.topics) or 1.0),
            "weight": topic.share / self.top,
            "no_drop": float(topic.no_drop),
            "oldest": float(bool(queue) and m is queue[0]),
            "own": float(self.newcomer is not None and lane == s.lane(self.newcomer)),
            "waited": per(age, 1e6),
            "silence": per(s.now - (s.sent[lane][-1]["us"] if s.sent[lane] else 0), 1e6),
            "lateness": 0.0 if topic.deadline_s is None else per(age, round(topic.deadline_s * 1e6)),
            "queued": len(queue) / self.L,
            "gain": self.gain(m) / self.top,
            "gain_per_byte": per(self.gain(m) / self.top / m["bytes"], np.mean(gains)),
        }

    def candidates(self):
        return self.sender.slots() + ([self.newcomer] if self.newcomer is not None else [])

    def slots(self):
        """{field: numbers of the L + 1 places}."""
        made = {name: [0.0] * (self.L + 1) for name in SLOT_NAMES}
        for k, m in enumerate(self.candidates()):
            for name, number in self.candidate(m, k).items():
                made[name][self.L if m is self.newcomer else k] = number
        return made

    def context(self):
        s, buffer, m = self.sender, self.buffer, self.newcomer
        most = buffer.max_bytes
        made = {
            "occupancy": len(s.slots()) / self.L,
            "backlog": sum(q["bytes"] for q in s.slots()) / most if most < UNLIMITED_BYTES else 0.0,
            **dict.fromkeys(("arrival_time_gap", "arrival_motion_gap", "even_value", "bend"), 0.0),
            "busy": float(bool(s.socket)),
            # One queue's means, which its own tests look after.
            "left": buffer.left_fraction,
            "stalled": per(buffer.stalled_us, (self.L + 1) * buffer.period_us),
            "departures": per(buffer.departures, 1),
            "service_ratio": per(buffer.service_ratio, 1),
            "socket_asks": float(m is None),
            "in_flight": per(len(s.in_flight), self.case.case.episode.window),
        }
        if m is not None:
            lane = s.lane(m)
            before, v = s.arrived[lane][-1:] or [m], self.v(lane)
            even_us, even_x = self.even(lane, "us", m["us"]), self.even(lane, "x", m["x"])
            made["arrival_time_gap"] = per(m["us"] - before[0]["us"], even_us)
            made["arrival_motion_gap"] = per(m["x"] - before[0]["x"], even_x)
            made["even_value"] = v(even_x) * self.topics[lane].share / self.top
            made["bend"] = (2 * v(even_x) - v(2 * even_x)) / v(even_x) if even_x > 0 else 0.0
        return made


@pytest.mark.kernels
@given(topic_cases(max_messages=25).filter(lambda case: len(case.topics) != 1))
def test_every_field_is_its_references(case):
    def check(event, senders, reference):
        if event == "decision" or (event == "send" and case.topics):
            seen = named(senders.batch)
            buffer = python_view(seen, 0)
            by_definition = Reference(case, reference, buffer)
            by_definition = by_definition.slots() | by_definition.context()
            arrival = seen.arrivals[0, min(seen.senders[0].next, seen.senders[0].arrivals - 1)]
            for name, numbers in observed(buffer, arrival, event == "decision").items():
                what = f"{name} at a {event}"
                np.testing.assert_allclose(numbers, by_definition[name], rtol=1e-6, atol=1e-6, err_msg=what)
                assert ((numbers >= 0) & (numbers <= 1)).all(), name

    case.beside_its_reference(check)


def test_the_reference_knows_every_field():
    known = {field.name for field in FIELDS + TOPIC_FIELDS}
    assert {*SLOT_NAMES, *CONTEXT_NAMES} == known, "tests/core/topic_cases.py observes them by definition"
    assert not [field.name for field in TOPIC_FIELDS if field.group != "topic"]


@pytest.mark.kernels
def test_no_loss_is_rounded_below_nothing():
    """V = min(1, d / 2.2), x = 1.3, 2.0, 2.3: V(0.7) + V(0.3) - V(1) comes out as -5.6e-17, which no space holds."""
    link = Link(Trace("dead", np.array([0, 10**6]), np.array([0, 0]), "hold"))
    senders = Senders(1, 3, saturating(2.2), max_messages=3)
    senders.load(0, Episode(messages(np.arange(3), 1, np.array([1.3, 2.0, 2.3])), link))
    while (event := next_event(senders.batch, None, 0)) != END:
        batch = named(senders.batch)
        if event == DECISION and batch.senders[0].next == 2:
            loss = observed(python_view(batch, 0), batch.arrivals[0, 2], True)["loss"]
            assert (loss >= 0).all() and loss[0] == 0
            break
        if event == DECISION:
            decide(senders.batch, 0, ACCEPT)
    assert event == DECISION


ON_BOARD = (*observe.ON_BOARD_FIELDS, *observe.ON_BOARD_SLOT_FIELDS)
OBSERVED = (*observe.FIELDS, *observe.TOPIC_FIELDS, *ON_BOARD)
TABLES = {"observed": OBSERVED, "of the rule": rule_inputs.INPUT_FIELDS, "scorers": (*observe.FIELDS, *ON_BOARD)}
GROUPS = {"queue", "time", "motion", "value", "link", "topic"}


@pytest.mark.parametrize("table", TABLES)
def test_names_are_unlike_and_each_field_is_documented(table: str) -> None:
    fields = TABLES[table]
    names = [field.name for field in fields]
    assert len(set(names)) == len(names)
    for field in fields:
        assert field.name.isidentifier() and field.per in ("slot", "context") and field.group in GROUPS, field.name
        assert field.unit and field.meaning and field.meaning == " ".join(field.meaning.split()), field.name
        assert field.low <= 0 <= field.high and field.low < field.high, field.name  # an empty slot is 0


def test_each_field_on_board_is_on_its_page() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "guide" / "yours-to-change.md").read_text(encoding="utf-8")
    lacking = [field.name for field in ON_BOARD if f"`{field.name}`" not in page]
    assert not lacking, f"docs/guide/yours-to-change.md does not name the fields {lacking}"


def check(fields: Iterable[Field], numbers: Iterable[object]) -> None:
    """Each field's numbers lie in its bounds."""
    for field, of_field in zip(fields, numbers, strict=True):
        seen = np.atleast_1d(np.asarray(of_field))
        assert ((field.low <= seen) & (seen <= field.high)).all(), (field.name, seen)


@pytest.mark.kernels
@given(cases(max_messages=25), VALUES)
def test_fields_of_one_queue_stay_in_their_bounds(case, v) -> None:
    def on_arrival(buffer, arrival, memory):
        width = buffer.capacity + 1
        numbers = observed(buffer, arrival, True)
        check(observe.FIELDS, [numbers[field.name] for field in observe.FIELDS])
        context, rows = np.zeros(len(observe.ON_BOARD_FIELDS)), np.zeros((len(observe.ON_BOARD_SLOT_FIELDS), width))
        observe.observe_on_board(buffer, arrival, context)
        observe.observe_on_board_slots(buffer, arrival, rows)
        check(ON_BOARD, [*context, *rows])
        context = np.zeros(rule_inputs.N_INPUTS)
        rule_inputs.recall(buffer, arrival, memory, rule_inputs.BASE)
        rule_inputs.inputs(buffer, arrival, memory, rule_inputs.BASE, context)
        check(rule_inputs.INPUT_FIELDS, context)
        return ANYTHING.on_arrival(buffer, arrival, memory)

    watched = policies.Policy(
        "watched", on_arrival, memory=rule_inputs.REMEMBERED, work=chains.SCRATCH, reads_rate=True
    )
    case.run(watched, v)


@pytest.mark.kernels
@given(topic_cases(min_topics=2, max_messages=25))
def test_fields_of_several_topics_stay_in_their_bounds(case: TopicCase) -> None:
    def on_arrival(buffer, arrival, memory):
        numbers = observed(buffer, arrival, True)
        fields = observe.FIELDS + observe.TOPIC_FIELDS
        check(fields, [numbers[field.name] for field in fields])
        return ANYTHING.on_arrival(buffer, arrival, memory)

    case.run(policies.Policy("watched", on_arrival, client=case.client, reads_rate=True, for_topics=True))


@pytest.mark.kernels
def test_a_tables_kernel_writes_what_its_functions_return() -> None:
    # Two fields from 3 on: of the facts a = 5 and b = 2, what one is longer than the other, and 5 / (5 + 2 + 3).
    table = (
        Field("longer", "context", "queue", "units", "a - b", lambda a, b: a - b),
        Field("part", "context", "queue", "g/(g+r), r = b + 3", "a", lambda a, b: declare.squash(a, b + 3)),
    )
    row = np.zeros(6)
    declare.writer(table, "a, b", first=3)(5.0, 2.0, row)
    assert row.tolist() == [0, 0, 0, 3, 0.5, 0]
    slots = [replace(field, per="slot") for field in table]
    rows = np.zeros((2, 3))
    declare.writer(slots, "a, b")(5.0, 2.0, 1, rows)
    assert rows.tolist() == [[0, 3, 0], [0, 0.5, 0]]

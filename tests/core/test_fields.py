"""Every field that is declared: its name is its own, a reader is told what it means, and it stays within its bounds."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from cases import ANYTHING, VALUES, cases
from hypothesis import given
from topic_cases import TopicCase, observed, topic_cases

from bufgym import policies
from bufgym.model import observe
from bufgym.model.observe import Field, declare
from bufgym.policies import guided, guided_topics
from bufgym.policies.rule_fields import RULE_FIELDS, RULE_SLOT_FIELDS, observe_rule

ON_BOARD = (*observe.ON_BOARD_FIELDS, *observe.ON_BOARD_SLOT_FIELDS)
OBSERVED = (*observe.FIELDS, *observe.TOPIC_FIELDS, *ON_BOARD)
TABLES = {
    "observed": OBSERVED,
    "guided": guided.INPUT_FIELDS,
    "guided topics": guided_topics.INPUT_FIELDS,
    "scorers": (*observe.FIELDS, *ON_BOARD, *RULE_FIELDS, *RULE_SLOT_FIELDS),
}
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
        context, rows = np.zeros(len(RULE_FIELDS)), np.zeros((len(RULE_SLOT_FIELDS), width))
        observe_rule(buffer, arrival, memory, rows, context)
        check((*RULE_FIELDS, *RULE_SLOT_FIELDS), [*context, *rows])
        return ANYTHING.on_arrival(buffer, arrival, memory)

    by_rule = policies.Policy("watched", on_arrival, memory=guided.REMEMBERED, work=guided.WORK, reads_rate=True)
    case.run(by_rule, v)


@pytest.mark.kernels
@given(topic_cases(min_topics=2, max_messages=25))
def test_fields_of_several_topics_stay_in_their_bounds(case: TopicCase) -> None:
    seen = np.zeros(len(guided_topics.INPUT_FIELDS))

    def on_arrival(buffer, arrival, memory):
        numbers = observed(buffer, arrival, True)
        fields = observe.FIELDS + observe.TOPIC_FIELDS
        check(fields, [numbers[field.name] for field in fields])
        guided_topics.write_inputs(buffer, seen)
        check(guided_topics.INPUT_FIELDS, seen)
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

"""One kernel writes the fields that are named: each has the numbers that it has in its whole table."""

import numpy as np
import pytest
from cases import ANYTHING, cases
from hypothesis import given
from hypothesis import strategies as st
from test_observe import VALUES

from bufgym import policies
from bufgym.model import observe
from bufgym.model.observe import BUILT_IN, CONTEXT_FIELDS, ON_BOARD_FIELDS, ON_BOARD_SLOT_FIELDS, SLOT_FIELDS

pytestmark = pytest.mark.kernels
GARBAGE = np.float32(-7.0)


def of_whole_tables(buffer, arrival):
    """Every built-in field out of its table, float32."""
    width = buffer.capacity + 1
    slots, context = np.zeros((len(SLOT_FIELDS), width), np.float32), np.zeros(len(CONTEXT_FIELDS), np.float32)
    observe.observe(buffer, arrival, slots, context)
    on_slots, on_board = (
        np.zeros((len(ON_BOARD_SLOT_FIELDS), width), np.float32),
        np.zeros(len(ON_BOARD_FIELDS), np.float32),
    )
    observe.observe_on_board_slots(buffer, arrival, on_slots)
    observe.observe_on_board(buffer, arrival, on_board)
    return dict(zip(BUILT_IN, [*slots, *context[:, None], *on_slots, *on_board[:, None]], strict=True))


def chosen_alone(buffer, arrival, names):
    """The same of these fields by ``write_chosen``, in a row whose last number belongs to nobody."""
    first, end = {}, 0
    for name in names:
        first[name] = end
        end += buffer.capacity + 1 if BUILT_IN[name].per == "slot" else 1
    row = np.full(end + 1, GARBAGE)
    observe.write_chosen(buffer, arrival, observe.chosen_at(first), row)
    assert row[-1] == GARBAGE
    return {
        name: row[k : k + buffer.capacity + 1] if BUILT_IN[name].per == "slot" else row[k : k + 1]
        for name, k in first.items()
    }


@given(cases(max_messages=25), VALUES, st.lists(st.permutations(list(BUILT_IN)), min_size=1, max_size=4), st.data())
def test_a_chosen_field_is_the_field_of_the_whole_table(case, v, orders, data):
    subsets = [order[: data.draw(st.integers(0, len(BUILT_IN)))] for order in orders]
    asked = 0

    def on_arrival(buffer, arrival, memory):
        nonlocal asked
        whole = of_whole_tables(buffer, arrival)
        alone = list(BUILT_IN)[asked % len(BUILT_IN)]  # each field in its turn
        for names in ([alone], subsets[asked % len(subsets)]):
            for name, numbers in chosen_alone(buffer, arrival, names).items():
                assert numbers.tobytes() == whole[name].tobytes(), name
        asked += 1
        return ANYTHING.on_arrival(buffer, arrival, memory)

    case.run(policies.Policy("compared", on_arrival, reads_rate=True), v)

"""Gaps counted in messages: by hand, and as those of a coordinate that is the messages' number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cases import ANYTHING, cases
from hypothesis import given
from test_sender import V, line

from bufgym import policies
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.observe import ON_BOARD_SLOT_FIELDS, SLOT_FIELDS, observe_on_board_slots, observe_slots

NUMBERS = [field.name for field in ON_BOARD_SLOT_FIELDS]
OTHERS = [field.name for field in SLOT_FIELDS]


def rows_of(buffer, arrival):
    rows = np.zeros((len(NUMBERS), buffer.capacity + 1))
    observe_on_board_slots(buffer, arrival, rows)
    return rows


def recorder(seen, decide):
    def on_arrival(buffer, arrival, memory):
        seen.append((buffer.dequeued_seq, rows_of(buffer, arrival)))
        one_by_one = [
            [f.function(buffer, arrival, k) for k in range(len(buffer.slots) + 1)] for f in ON_BOARD_SLOT_FIELDS
        ]
        where = [*range(len(buffer.slots)), buffer.capacity]
        np.testing.assert_array_equal(seen[-1][1][:, where], one_by_one)
        return decide(buffer, arrival, memory)

    return policies.Policy("recorder", on_arrival)


def test_gaps_by_hand():
    # The socket takes message 0 at once and holds it; 1 is kept, 2 and 3 are rejected, 4 is kept, 5 asks. L = 2: the
    # even spacing is 5 / 3 messages, and a third of 1, 2.5 and so on comes of gap / (gap + spacing).
    seen = []
    keep = {0, 1, 4}
    line([0, 1, 1, 1, 1, 9], sizes=100_000).run(
        recorder(seen, lambda buffer, arrival, memory: ACCEPT if arrival.seq in keep else REJECT)
    )
    assert [seq for seq, _ in seen] == [0, 0, 0, 0, 0, 0]
    even = 5 / 3
    before, merged = np.array([1, 3, 1]), np.array([4, 4, 2])
    np.testing.assert_allclose(seen[5][1], [before / (before + even), merged / (merged + 2 * even)])
    # Message 1 was asked for before anything but 0: one message since, and the next is one more.
    np.testing.assert_allclose(seen[1][1][:, [0, 2]], [[0, 1 / (1 + 1 / 3)], [0, 2 / (2 + 2 / 3)]])


@given(cases())
def test_a_coordinate_that_counts_messages_has_the_same_gaps(case):
    arrivals = case.episode.arrivals.copy()
    arrivals["x"] = np.arange(len(arrivals))
    case = replace(case, episode=replace(case.episode, arrivals=arrivals))

    def on_arrival(buffer, arrival, memory):
        if arrival.seq > 0:  # the first of all has no step behind it
            slots = np.zeros((len(OTHERS), buffer.capacity + 1))
            observe_slots(buffer, arrival, slots)
            of_x = [slots[OTHERS.index(name)] for name in ("motion_before", "motion_merged")]
            np.testing.assert_allclose(rows_of(buffer, arrival), of_x, rtol=1e-6)
        return ANYTHING.on_arrival(buffer, arrival, memory)

    case.run(policies.Policy("compared", on_arrival), V)

"""The bounded buffer: an array row against a list, and the gaps between what it holds."""

from __future__ import annotations

import pytest
from cases import queue_of
from hypothesis import given
from hypothesis import strategies as st

from bufgym.kernel import records
from bufgym.model import qoi
from bufgym.model.buffer import (
    MESSAGE,
    arrival_gain,
    evict,
    loss,
    motion_gaps,
    push,
    row_width,
    time_gaps,
)

pytestmark = pytest.mark.kernels


@given(st.integers(1, 6), st.lists(st.one_of(st.none(), st.integers(-1, 5)), max_size=80))
def test_agrees_with_a_list(L, actions):
    """None: push (evicting the head when full); -1: the socket takes the head; k: evict slot k."""
    slots = records((2, row_width(L)), MESSAGE)
    first, queue, sent, pushed = 1, [], 0, 0
    for action in actions:
        if action is None:
            if len(queue) == L:
                first = evict(slots, 1, first, L, 0)
                queue.pop(0)
            pushed += 1
            arrival = records(1, MESSAGE)
            arrival["seq"] = pushed
            first = push(slots, 1, first, len(queue), arrival[0])
            queue.append(pushed)
        elif action == -1 and queue:
            first, sent = first + 1, queue.pop(0)
        elif 0 <= action < len(queue):
            first = evict(slots, 1, first, len(queue), action)
            queue.pop(action)
        # The message taken last stands before the head, and the neighbouring row is untouched.
        assert slots["seq"][1, first - 1 : first + len(queue)].tolist() == [sent, *queue]
    assert (slots["seq"][0] == 0).all()


def buffer(times_us, x, v=None, **known):
    """A buffer that holds messages with these arrival times and coordinates."""
    held = queue_of(len(x), len(x))._replace(**{"v": (v or qoi.exponential(0.5)).array, "dequeued": 1, **known})
    held.slots["arrival_us"], held.slots["x"] = times_us, x
    return held


def message(us, x):
    made = records(1, MESSAGE)
    made["arrival_us"], made["x"] = us, x
    return made[0]


def test_gaps_by_hand():
    # Sent: at 0. Queued: at 10 and 30. The newcomer comes at 60; the arrival before it came at 45 and was rejected.
    held = buffer([10, 30], [1.0, 1.5], previous_us=45, previous_x=3.0)
    newcomer = message(60, 5.0)
    assert [time_gaps(held, newcomer, k) for k in range(3)] == [(10, 20), (20, 30), (30, 15)]
    assert [motion_gaps(held, newcomer, k) for k in range(3)] == [(1.0, 0.5), (0.5, 3.5), (3.5, 2.0)]
    # V = 1 - 0.5^d: slot 0 loses V(1) + V(0.5) - V(1.5) = (1 - 0.5^1)(1 - 0.5^0.5)
    assert loss(held, newcomer, 0) == pytest.approx(0.5 * (1 - 0.5**0.5))
    assert arrival_gain(held, newcomer) == 1 - 0.5**3.5


def test_gain_of_a_newcomer_to_an_empty_buffer():
    assert arrival_gain(buffer([], [], dequeued_x=2.0), message(9, 3.0)) == 0.5
    assert arrival_gain(buffer([], [], dequeued=0), message(9, 3.0)) == 0  # the very first message is the 1 in H

"""Fields that see bytes: beside what the link carries, beside each other, and for each slot's gap."""

import math

import gymnasium as gym
import numpy as np
import pytest
from cases import newcomer, queue_of, watched
from test_sender import line

from bufgym.model.buffer import ACCEPT
from bufgym.model.observe import ON_BOARD_FIELDS, ON_BOARD_SLOT_FIELDS, observe_on_board, observe_on_board_slots

pytestmark = pytest.mark.kernels

BYTE_FIELDS = ("newcomer_bytes", "size_spread", "load", "bytes_in_period", "gap_per_byte")


def queue(sizes, **known):
    """Messages of these sizes at x = 1, 2, ..., the last of them the newcomer; one each 10 ms; 0 was dequeued."""
    buffer = queue_of(len(sizes) - 1, 4)._replace(period_us=1e4, **known)
    slots, arrival = buffer.slots.view(np.recarray), newcomer()
    for k, message in enumerate([*slots, arrival]):
        message["size_bytes"], message["x"], message["seq"] = sizes[k], k + 1, k + 1
    return buffer._replace(slots=slots, previous_x=len(sizes) - 1, backlog_bytes=sum(sizes[:-1])), arrival


def seen(sizes, **known):
    """Context fields as numbers, slot fields as lists with the newcomer last; the tables hold the same."""
    buffer, arrival = queue(sizes, **known)
    found = {field.name: field.function(buffer, arrival) for field in ON_BOARD_FIELDS}
    table, rows = np.zeros(len(ON_BOARD_FIELDS)), np.zeros((len(ON_BOARD_SLOT_FIELDS), buffer.capacity + 1))
    observe_on_board(buffer, arrival, table)
    observe_on_board_slots(buffer, arrival, rows)
    assert dict(zip(found, table, strict=True)) == found
    for field, row in zip(ON_BOARD_SLOT_FIELDS, rows, strict=True):
        found[field.name] = [field.function(buffer, arrival, k) for k in range(len(sizes))]
        assert [*row[: len(sizes) - 1], row[-1]] == found[field.name]
        assert not row[len(sizes) - 1 : -1].any()
    return found


def test_bytes_beside_what_the_link_carries():
    # 300 kB/s for 10 ms are 3000 bytes: a message of 1000 is a quarter of 4000, one of 9000 three quarters of 12000.
    found = seen([1_000, 3_000, 9_000], long_rate_bytes_per_s=3e5, arrival_bytes=6_000.0)
    assert found["bytes_in_period"] == pytest.approx([1 / 4, 1 / 2, 3 / 4])
    assert found["newcomer_bytes"] == pytest.approx(3 / 4)
    # 6000 bytes arrive where 3000 leave.
    assert found["load"] == pytest.approx(2 / 3)
    # Before the link has carried anything, every message is more than it carries.
    at_first = seen([1_000], arrival_bytes=1_000.0)
    assert at_first["load"] == at_first["newcomer_bytes"] == at_first["bytes_in_period"][0] == 1


def test_spread_of_sizes():
    assert seen([5_000])["size_spread"] == 0
    assert seen([5_000, 5_000, 5_000])["size_spread"] == 0
    # Logarithms l and l + log 4 differ from their mean by log 2.
    assert seen([1_000, 4_000])["size_spread"] == pytest.approx(math.log(2))
    # Logarithms l, l and l + 0.6 (their mean l + 0.2) have the variance (0.04 + 0.04 + 0.16) / 3.
    assert seen([10**9, 10**9, round(10**9 * math.exp(0.6))])["size_spread"] == pytest.approx(math.sqrt(0.08))
    assert seen([1, 10_000_000])["size_spread"] == 1


def test_gap_per_byte():
    # All gaps left are 2: 2 per 1000, 2 per 4000 and 2 per 2000 bytes, that is 4, 1 and 2 parts with the mean 7/3.
    parts = np.array([4, 1, 2])
    assert seen([1_000, 4_000, 2_000])["gap_per_byte"] == pytest.approx(parts / (parts + 7 / 3))
    # A newcomer that nothing has moved before: no gap, and nothing to compare it with.
    buffer, arrival = queue([1_000])
    still = buffer._replace(dequeued_x=1.0, previous_x=1.0)
    assert next(f for f in ON_BOARD_SLOT_FIELDS if f.name == "gap_per_byte").function(still, arrival, 0) == 0


def test_what_arrives_counts_although_it_is_not_kept():
    # The policy keeps messages of 1000 bytes alone; half of those that arrive have 9000.
    load = next(field for field in ON_BOARD_FIELDS if field.name == "load").function
    policy, loads = watched(
        lambda buffer, arrival: (buffer.arrival_bytes, load(buffer, arrival)),
        lambda buffer, arrival, memory: ACCEPT if arrival.size_bytes == 1_000 else -1,
    )
    line([0, 1, 2, 3], sizes=[1_000, 9_000, 1_000, 9_000], capacity=8).run(policy)
    assert [bytes for bytes, _ in loads] == [1_000, 2_000, 1_875, 2_765.625]
    # 1 MB/s and a message each ms: 1000 bytes leave where 2765.625 arrive.
    assert loads[3][1] == pytest.approx(2_765.625 / 3_765.625)


@pytest.mark.parametrize("id", ["bufgym/Uplink-v0", "bufgym/Topics-v0"])
def test_environments_observe_them_where_they_are_named(id):
    env = gym.make(id, fields=["rank", *BYTE_FIELDS], capacity=4)
    _, info = env.reset(seed=1)
    for _ in range(60):
        observation, _, ended, _, info = env.step(int(np.flatnonzero(info["action_mask"])[0]))
        assert env.observation_space.contains(observation)
        if ended:
            _, info = env.reset()
    assert set(BYTE_FIELDS) < set(observation)

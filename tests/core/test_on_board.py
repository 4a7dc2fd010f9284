"""Fields of what a robot has on board: the link's rate by hand and by the reference model, gaps in messages, bytes."""

import math
from dataclasses import replace
from types import FunctionType

import gymnasium as gym
import naive
import numpy as np
import pytest
from cases import ANYTHING, cases, newcomer, queue_of, watched
from hypothesis import given
from test_sender import V, line

from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.model import observe
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.model.observe import (
    ON_BOARD_FIELDS,
    ON_BOARD_SLOT_FIELDS,
    observe_on_board,
    observe_on_board_slots,
    on_board,
)
from bufgym.scenario import draw
from bufgym.sim import rollout, run

pytestmark = pytest.mark.kernels


def drained(buffer, arrival):
    """What a policy sees of the link's rate."""
    rates = buffer.short_rate_bytes_per_s, buffer.medium_rate_bytes_per_s, buffer.long_rate_bytes_per_s
    return (buffer.drained_bytes, buffer.drained_us, *rates)


@given(cases())
def test_the_links_rate_as_the_reference_measures_it(case):
    case = replace(case, decide_at="arrival", episode=replace(case.episode, first_decision=0, last_decision=2**31))
    policy, seen = watched(drained)
    case = replace(case, max_bytes=None)
    case.run(policy, V)
    measured = case.run_reference(naive.policy("drop-newest", V)).measured
    reference = [(m["drained"], m["drained_us"], *(1e6 * m[n] for n in ("short", "medium", "long"))) for m in measured]
    assert seen == reference


def seen(**known):
    """The fields of an empty queue of L = 3 that a newcomer of 1000 bytes, 4 gaps on, meets each 10 ms."""
    arrival = newcomer()
    arrival["size_bytes"], arrival["x"] = 1_000, 4.0
    buffer = queue_of(0, 3)._replace(period_us=1e4, **known)
    numbers = {field.name: field.function(buffer, arrival) for field in observe.ON_BOARD_FIELDS}
    table = np.zeros(len(observe.ON_BOARD_FIELDS))
    observe.observe_on_board(buffer, arrival, table)
    assert dict(zip(numbers, table, strict=True)) == numbers
    return numbers


def test_fields_by_hand():
    # A message of 1000 bytes each 10 ms is a demand of 100 kB/s.
    rates = {"short_rate_bytes_per_s": 3e5, "medium_rate_bytes_per_s": 1e5, "long_rate_bytes_per_s": 1e5}
    on_link = seen(**rates, left_bytes=9_000)
    assert [on_link[f"rate_{n}"] for n in ("short", "medium", "long")] == pytest.approx([0.75, 0.5, 0.5])
    assert on_link["rate_trend"] == 0.75
    # 9000 bytes take 30 ms, three periods; at no rate for ever.
    assert on_link["time_to_free"] == 0.75
    assert seen(left_bytes=9_000)["time_to_free"] == 1
    assert seen()["time_to_free"] == 0
    assert [seen(remaining_us=us)["remaining"] for us in (0, 10_000_000, 30_000_000)] == [0, 0.5, 0.75]
    assert seen()["remaining"] == 1  # nobody told it


def test_only_those_who_read_the_rate_have_it_measured():
    assert not policies.get("afr").measures
    assert policies.Policy("own", lambda buffer, arrival, memory: ACCEPT).measures


def names_read(policy):
    """Names that the policy's functions read, and all functions that they call."""
    names, waiting, seen = set(), [getattr(function, "py_func", function) for function in policy.compiled], set()
    while waiting:
        function = waiting.pop()
        if function not in seen:
            seen.add(function)
            names |= set(function.__code__.co_names)
            called = (function.__globals__.get(name) for name in function.__code__.co_names)
            waiting += [f for f in (getattr(one, "py_func", one) for one in called) if isinstance(f, FunctionType)]
    return names


@pytest.mark.parametrize("name", [name for name in policies.names() if policies.get(name).compile])
def test_what_a_policy_reads_of_the_socket_is_there(name):
    policy = policies.get(name)
    names = names_read(policy)
    assert policy.measures or policy.reads_left or not names & {"left_bytes", "left_fraction"}
    assert policy.measures or not names & {"short_rate_bytes_per_s", "medium_rate_bytes_per_s", "drained_us"}


def test_a_rollout_of_its_own_does_the_same(monkeypatch):
    episodes = [draw(scenarios.get("lte", duration_s=4.0), seed) for seed in range(3)]
    for name in ("afr", "codel"):
        logs = []
        for pays_s in (np.inf, -1.0):
            monkeypatch.setattr(rollout, "_PAYS_IF_READY_S", pays_s)
            monkeypatch.setattr(rollout, "_PAYS_S", pays_s)
            batch = run(policies.get(name), episodes, 4, V).batch
            logs.append([np.asarray(array).tobytes() for array in (batch.log, batch.order, batch.slots)])
        assert logs[0] == logs[1], name


NUMBERS = [field.name for field in observe.ON_BOARD_SLOT_FIELDS]
OTHERS = [field.name for field in observe.SLOT_FIELDS]


def slots_of(field, buffer, arrival):
    """The field's number for each queued message and the newcomer."""
    whole = on_board.queue_of(buffer, arrival)
    return [field.function(buffer, arrival, k, whole) for k in range(len(buffer.slots) + 1)]


def rows_of(buffer, arrival):
    rows = np.zeros((len(NUMBERS), buffer.capacity + 1))
    observe.observe_on_board_slots(buffer, arrival, rows)
    return rows


def test_gaps_in_messages_by_hand():
    # The socket takes message 0 at once and holds it; 1 is kept, 2 and 3 are rejected, 4 is kept, 5 asks. L = 2: the
    # even spacing is 5 / 3 messages, and a third of 1, 2.5 and so on comes of gap / (gap + spacing).
    seen = []

    def on_arrival(buffer, arrival, memory):
        seen.append((buffer.dequeued_seq, rows_of(buffer, arrival)))
        s = len(buffer.slots)
        one_by_one = [slots_of(field, buffer, arrival) for field in observe.ON_BOARD_SLOT_FIELDS]
        np.testing.assert_array_equal(seen[-1][1][:, [*range(s), buffer.capacity]], one_by_one)
        return ACCEPT if arrival.seq in (0, 1, 4) else REJECT

    line([0, 1, 1, 1, 1, 9], sizes=100_000).run(policies.Policy("recorder", on_arrival))
    assert [seq for seq, _ in seen] == [0, 0, 0, 0, 0, 0]
    even = 5 / 3
    before, merged = np.array([1, 3, 1]), np.array([4, 4, 2])
    np.testing.assert_allclose(seen[5][1][:2], [before / (before + even), merged / (merged + 2 * even)])
    # Message 1 was asked for before anything but 0: one message since, and the next is one more.
    np.testing.assert_allclose(seen[1][1][:2, [0, 2]], [[0, 1 / (1 + 1 / 3)], [0, 2 / (2 + 2 / 3)]])


@given(cases())
def test_a_coordinate_that_counts_messages_has_the_same_gaps(case):
    arrivals = case.episode.arrivals.copy()
    arrivals["x"] = np.arange(len(arrivals))
    case = replace(case, episode=replace(case.episode, arrivals=arrivals))

    def on_arrival(buffer, arrival, memory):
        if arrival.seq > 0:  # the first of all has no step behind it
            slots = np.zeros((len(OTHERS), buffer.capacity + 1))
            observe.observe(buffer, arrival, slots, np.zeros(len(observe.CONTEXT_FIELDS)))
            of_x = [slots[OTHERS.index(name)] for name in ("motion_before", "motion_merged")]
            np.testing.assert_allclose(rows_of(buffer, arrival)[:2], of_x, rtol=1e-6)
        return ANYTHING.on_arrival(buffer, arrival, memory)

    case.run(policies.Policy("compared", on_arrival), V)


BYTE_FIELDS = ("newcomer_bytes", "size_spread", "load", "bytes_in_period", "gap_per_byte")


def queue(sizes, **known):
    """Messages of these sizes at x = 1, 2, ..., the last of them the newcomer; one each 10 ms; 0 was dequeued."""
    buffer = queue_of(len(sizes) - 1, 4)._replace(period_us=1e4, **known)
    slots, arrival = buffer.slots.view(np.recarray), newcomer()
    for k, message in enumerate([*slots, arrival]):
        message["size_bytes"], message["x"], message["seq"] = sizes[k], k + 1, k + 1
    return buffer._replace(slots=slots, previous_x=len(sizes) - 1, backlog_bytes=sum(sizes[:-1])), arrival


def of_sizes(sizes, **known):
    """Context fields as numbers, slot fields as lists with the newcomer last; the tables hold the same."""
    buffer, arrival = queue(sizes, **known)
    found = {field.name: field.function(buffer, arrival) for field in ON_BOARD_FIELDS}
    table, rows = np.zeros(len(ON_BOARD_FIELDS)), np.zeros((len(ON_BOARD_SLOT_FIELDS), buffer.capacity + 1))
    observe_on_board(buffer, arrival, table)
    observe_on_board_slots(buffer, arrival, rows)
    assert dict(zip(found, table, strict=True)) == found
    for field, row in zip(ON_BOARD_SLOT_FIELDS, rows, strict=True):
        found[field.name] = slots_of(field, buffer, arrival)
        assert [*row[: len(sizes) - 1], row[-1]] == found[field.name]
        assert not row[len(sizes) - 1 : -1].any()
    return found


def test_bytes_beside_what_the_link_carries():
    # 300 kB/s for 10 ms are 3000 bytes: a message of 1000 is a quarter of 4000, one of 9000 three quarters of 12000.
    found = of_sizes([1_000, 3_000, 9_000], long_rate_bytes_per_s=3e5, arrival_bytes=6_000.0)
    assert found["bytes_in_period"] == pytest.approx([1 / 4, 1 / 2, 3 / 4])
    assert found["newcomer_bytes"] == pytest.approx(3 / 4)
    # 6000 bytes arrive where 3000 leave.
    assert found["load"] == pytest.approx(2 / 3)
    # Before the link has carried anything, every message is more than it carries.
    at_first = of_sizes([1_000], arrival_bytes=1_000.0)
    assert at_first["load"] == at_first["newcomer_bytes"] == at_first["bytes_in_period"][0] == 1


def test_spread_of_sizes():
    assert of_sizes([5_000])["size_spread"] == 0
    assert of_sizes([5_000, 5_000, 5_000])["size_spread"] == 0
    # Logarithms l and l + log 4 differ from their mean by log 2.
    assert of_sizes([1_000, 4_000])["size_spread"] == pytest.approx(math.log(2))
    # Logarithms l, l and l + 0.6 (their mean l + 0.2) have the variance (0.04 + 0.04 + 0.16) / 3.
    assert of_sizes([10**9, 10**9, round(10**9 * math.exp(0.6))])["size_spread"] == pytest.approx(math.sqrt(0.08))
    assert of_sizes([1, 10_000_000])["size_spread"] == 1


def test_gap_per_byte():
    # All gaps left are 2: 2 per 1000, 2 per 4000 and 2 per 2000 bytes, that is 4, 1 and 2 parts with the mean 7/3.
    parts = np.array([4, 1, 2])
    assert of_sizes([1_000, 4_000, 2_000])["gap_per_byte"] == pytest.approx(parts / (parts + 7 / 3))
    # A newcomer that nothing has moved before: no gap, and nothing to compare it with.
    buffer, arrival = queue([1_000])
    still = buffer._replace(dequeued_x=1.0, previous_x=1.0)
    assert slots_of(next(f for f in ON_BOARD_SLOT_FIELDS if f.name == "gap_per_byte"), still, arrival)[0] == 0


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


@pytest.mark.parametrize("id", ["bufgym/Uplink-v1", "bufgym/Topics-v0"])
def test_environments_observe_them_where_they_are_named(id):
    env = gym.make(id, fields=["rank", *BYTE_FIELDS], capacity=4, observation="dict")
    _, info = env.reset(seed=1)
    for _ in range(60):
        observation, _, ended, _, info = env.step(int(np.flatnonzero(info["action_mask"])[0]))
        assert env.observation_space.contains(observation)
        if ended:
            _, info = env.reset()
    assert set(BYTE_FIELDS) < set(observation)

"""Behaviour that small bugs, planted at random (``.ci/mutants``), were free to change. Numbers worked by hand."""

import numpy as np
import pytest
from cases import trace

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import UNLIMITED_BYTES
from bufgym.model.link import Link
from bufgym.oracle import beam, programme
from bufgym.policies import webrtc
from bufgym.scenario import Episode, messages
from bufgym.sim import Senders, audit
from bufgym.sim.state import NEVER

pytestmark = pytest.mark.kernels

V = qoi.exponential(0.5)
"""V(1) = 1/2, V(2) = 3/4, V(3) = 7/8."""


def finished() -> Senders:
    """L = 2, a byte a us for 20 us, messages of 10 bytes: 0 and 2 are sent, 3 not all, 4 and 5 wait, 1 is dropped."""
    episode = Episode(messages(np.array([0, 1, 2, 3, 15, 25]), 10), Link(trace([(0, 0), (20, 20)], "stop")))
    senders = Senders(1, 2, V, max_messages=6)
    senders.load(0, episode)
    senders.run(policies.get("drop-oldest"))
    return senders


def add(table, field, k, amount):
    """A policy that adds to a field of the k-th entry; for the sender's only one k is 0."""

    def write(batch):
        rows = np.asarray(getattr(batch, table))
        (rows if table == "senders" else rows[0])[field][k] += amount

    return f"{table} {k}: {field} {amount:+g}", write


def put(field, k, us):
    """A policy that writes a time into the log."""

    def write(batch):
        np.asarray(batch.log)[0][field][k] = us

    return f"log {k}: {field} = {us}", write


def repeat(batch):
    batch.slots[0, 3] = batch.slots[0, 2]


MESSAGE_FIELDS = ("seq", "arrival_us", "size_bytes", "topic", "x", "uniform")
RULES = ("priority", "weight", "period_us", "limit", "no_drop", "deadline_us", "v_start")
FORGERIES = [
    *[(audit.ARRIVAL, *add("arrivals", field, k, 1)) for field in MESSAGE_FIELDS for k in (0, 5)],
    *[(audit.QUEUED, *add("slots", field, k, 1)) for field in MESSAGE_FIELDS for k in (2, 3)],
    *[(audit.QUEUED, *add("slots", "seq", k, amount)) for k, amount in ((2, -100), (3, 100))],
    *[(audit.QUEUED, *put(field, k, 40)) for field in ("dequeued_us", "dropped_us") for k in (4, 5)],
    (audit.QUEUED, "one message twice", repeat),
    *[(audit.BYTES, *add("senders", "backlog_bytes", 0, amount)) for amount in (1, -1)],
    (audit.LOG, *put("dropped_us", 0, 7)),  # was sent
    (audit.LOG, *put("dropped_us", 1, NEVER)),  # was not sent either
    (audit.LOG, *put("dequeued_us", 2, 1)),  # came at 2
    *[
        (audit.LOG, *add("senders", field, 0, amount))
        for field in ("dequeued", "evicted", "rejected", "next")
        for amount in (1, -1)
    ],
    *[(audit.TOPIC, *add("topics", field, 0, 1)) for field in RULES],
    *[(audit.QOI, *add("senders", "delivered_gain", 0, amount)) for amount in (1e-6, -1e-6)],
    ("", *add("senders", "delivered_gain", 0, 1e-10)),  # rounding
]


@pytest.mark.parametrize(("finding", "write"), [pytest.param(n, w, id=name) for n, name, w in FORGERIES])
def test_a_run_is_searched_for_everything_a_policy_may_not_write(finding, write):
    senders = finished()
    given = senders.batch, 0, senders.episodes[0], senders.topic_table
    assert audit.touched(*given) == ""
    write(senders.batch)
    assert audit.touched(*given) == finding


@pytest.mark.parametrize(
    ("capacity", "max_bytes", "width", "plan"),
    [
        (2, UNLIMITED_BYTES, 4, [0, 1, 2]),
        (1, UNLIMITED_BYTES, 4, [0, 2]),  # while 0 crosses until 10, one can wait: V(2)
        (3, 20, 4, [0, 1, 2]),
        (3, 19, 4, [0, 2]),
        (2, UNLIMITED_BYTES, 1, [0, 1, 2]),  # of the ways to send 2 the best one is remembered, not the last
    ],
)
def test_a_beam_keeps_to_the_room(capacity, max_bytes, width, plan):
    """Three messages of 10 bytes arrive at bytes 0, 1 and 2 of the link."""
    c, size, far = np.arange(3), np.full(3, 10), np.full(3, 100)
    p = programme.new_problem(c, size, far, np.zeros(3, np.int64), np.arange(3.0), V.array, 2**62, 1)
    room = programme.Room(capacity, max_bytes, np.zeros((2, 200)), np.zeros((2, 4)), p.future)
    work = np.empty(3, np.int64)
    length, gain = beam.search(p, room, beam.new_states(3, width), work)
    assert work[:length][::-1].tolist() == plan
    assert gain == {2: 0.75, 3: 1.0}[length]


def test_webrtc_starts_a_new_pattern_when_the_bucket_gets_too_full_and_not_while_it_is():
    """1 byte/us: the bucket holds 500 kB, and 40 ms leak 40 kB."""
    memory = policies.get("webrtc-frame-dropper").new_memory()[0]
    for level, count, above in ((600_000, 0, 1), (600_000, 3, 1), (540_000, 3, 1), (539_000, 3, 0), (541_000, 0, 1)):
        memory[[webrtc.TARGET, webrtc.LEVEL, webrtc.COUNT]] = 1.0, level, 3.0
        webrtc.leak(memory, 40_000.0)
        assert (memory[webrtc.LEVEL], memory[webrtc.COUNT], memory[webrtc.ABOVE]) == (level - 40_000, count, above)

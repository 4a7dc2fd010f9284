"""Middleware that sends in fragments beside what a real one did, and WebRTC's frame dropper beside its reference model.

``test_policy_registry`` has each decision of all of them beside their reference models.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from cases import log, order
from hypothesis import given
from hypothesis import strategies as st
from naive_fragments import FrameDropper

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.policies import webrtc
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.traces import Trace

kernels = pytest.mark.kernels
V = qoi.exponential(0.618)
MS = 1_000


def delivered(spec, times_ms, size_bytes, bytes_per_ms, capacity=8):
    """What arrives of messages at these times, ms, over a steady link."""
    arrivals = messages((np.asarray(times_ms) * MS).astype(np.int64), size_bytes)
    link = Link(Trace.constant(1e3 * bytes_per_ms, 1_000))
    return order(run(policies.get(spec), [Episode(arrivals, link)], capacity, V))


def camera(spec, megabytes_per_s, count=300):
    """Frames of 230 kB, 30 a second, of which so many arrive over a steady link."""
    return len(delivered(spec, np.arange(count) * 1e3 / 30, 230_000, 1e3 * megabytes_per_s))


@pytest.mark.parametrize(
    ("megabytes_per_s", "sent", "real"),
    [(3, 240, 3), (4, 300, 2), (5, 300, 128), (6, 300, 222), (6.5, 300, 268), (8, 300, 300)],
)
def test_zenoh_is_near_the_real_one(megabytes_per_s, sent, real):
    """``real``: what eclipse-zenoh 1.10.2 delivered over TCP through a relay of that rate, so_sndbuf = 131072.

    Drop tail, which loses no fragment, delivers 112 of 240 over 3 MB/s.
    """
    # Besides, one a second measures the link.
    assert abs(camera("zenoh-drop", megabytes_per_s, sent) - real) <= 0.05 * sent + sent / 30


def test_large_messages_over_a_small_queue():
    # 24 Mbit/s, a queue of 200 kB, frames of 230 kB: of 300 the real ones delivered 5 (best effort) and 2 (reliable).
    assert camera("ros2-best-effort", 3) == 0
    assert camera("ros2-reliable-udp:depth=15", 3) <= 10  # one a second measures the link
    assert camera("ros2-reliable-udp:depth=15", 7) == camera("ros2-best-effort:queue_kb=1000", 7) == 300


def dropper(**state):
    memory = policies.get("webrtc-frame-dropper").new_memory()[0]
    for name, number in state.items():
        memory[getattr(webrtc, name)] = number
    return memory


@kernels
def test_webrtc_drops_evenly_what_the_ratio_says():
    def pattern(ratio, frames=12):
        memory = dropper(RATIO=ratio)
        return "".join("x" if webrtc.drops_frame(memory, 33_333.0) else "." for _ in range(frames))

    assert pattern(0.0) == "............"
    assert pattern(0.25) == "x..." * 3  # one in four
    assert pattern(0.5) == "x." * 6
    assert pattern(0.75) == "xxx." * 3


FRAMES = st.tuples(
    st.sampled_from([0.05, 0.3, 1.0, 1.0, 3.0]),  # the target, bytes/us
    st.sampled_from([3_000.0, 30_000.0, 100_000.0, 400_000.0]),
    st.sampled_from([1_000.0, 33_333.0, 40_000.0, 600_000.0]),
)


@kernels
@given(st.lists(FRAMES, min_size=20, max_size=60))
def test_webrtc_is_its_reference_frame_by_frame(frames):
    """The bucket shrinks with its target, leaks and follows; a large frame is spread; patterns begin anew."""
    reference, memory = FrameDropper(), dropper()
    for target, size, period_us in frames:
        reference.sender = SimpleNamespace(periods=[period_us])
        reference.set_rates(target), reference.leak()
        webrtc.retarget(memory, target), webrtc.leak(memory, period_us)
        assert memory[[webrtc.LEVEL, webrtc.RATIO]] == pytest.approx([reference.accumulator, reference.ratio])
        dropped = webrtc.drops_frame(memory, period_us)
        assert dropped == reference.drop_frame()
        if not dropped:
            reference.fill(size), webrtc.fill(memory, size, period_us)
            assert (memory[webrtc.LEVEL], memory[webrtc.LARGE_LEFT]) == (
                pytest.approx(reference.accumulator),
                reference.large_count,
            )


@kernels
def test_webrtc_pauses_while_nothing_leaves():
    # The link stands still from 100 ms on. Message 5 comes then; 6 sees that nothing has left since.
    link = Trace("stops", np.array([0, 100_000, 100_001]), np.array([0, 1_000, 1_000]), after="stop")
    arrivals = messages(np.arange(20, dtype=np.int64) * 20_000, 100)
    senders = run(policies.get("webrtc-frame-dropper"), [Episode(arrivals, Link(link))], 50, V)
    assert sorted(log(senders)["dropped_us"]) == list(range(6, 20))


def test_webrtc_keeps_all_of_a_stream_that_the_link_carries():
    assert camera("webrtc-frame-dropper", 7) == 300
    # Else the bucket, not the queue, decides: of L = 50 it leaves the larger part empty.
    arrivals = messages(np.arange(600, dtype=np.int64) * 33_333, 230_000)
    senders = run(policies.get("webrtc-frame-dropper"), [Episode(arrivals, Link(Trace.constant(3e6, 60)))], 50, V)
    assert 1.2e6 < senders.batch.senders[0]["peak_backlog_bytes"] < 3.5e6

"""A recording sent over a link: its frames as an episode, and the frames that arrive under a policy."""

from collections.abc import Sequence as Seq
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.model.link import Link
from bufgym.policies.registry import Policy
from bufgym.scenario import Episode
from bufgym.scenario.arrivals import messages
from bufgym.scenario.suites import motion_value
from bufgym.sim import metrics
from bufgym.traces import Trace
from bufgym_papers.perception.frames import Sequence

SIZED_EVERY = 10  # Distance between frames that are encoded; sizes between them are interpolated


@lru_cache(maxsize=8)
def sizes(sequence: Sequence) -> NDArray[np.int64]:
    """Bytes of each frame as it is sent, int64[frames]."""
    return between([sequence.size_bytes(int(k)) for k in encoded(len(sequence))], len(sequence))


def encoded(frames: int) -> NDArray[np.int64]:
    """Select the frames whose sizes are measured: one in ``SIZED_EVERY``, and the last."""
    return np.unique(np.append(np.arange(0, frames, SIZED_EVERY), frames - 1))


def between(measured: Seq[int], frames: int) -> NDArray[np.int64]:
    """Interpolate all frames' sizes from the measured sizes of ``encoded``, int64[frames]."""
    return np.rint(np.interp(np.arange(frames), encoded(frames), measured)).astype(np.int64)


def fading(stream_us: int, trace: Trace, offset_us: int = 0) -> Link:
    """Make the link of a stream that begins ``offset_us`` into a stretch of the trace as long as the stream.

    The stretch then repeats. So for any offset the link carries the same while the stream lasts, and a fade only meets
    another place on the camera's path, earlier by the offset.
    """
    until_us = min(int(stream_us), int(trace.duration_us))
    inside = trace.time_us < until_us
    time_us = np.append(trace.time_us[inside], until_us)
    carried = Link(trace).carried_at(until_us)
    cumulative = np.append(trace.cumulative_bytes[inside], carried)
    return Link(Trace(trace.name, time_us, cumulative, after="loop"), int(offset_us) % until_us)


def episode(sequence: Sequence, size_bytes: NDArray[np.int64], link: Link, seed: int = 0) -> Episode:
    """Make the episode of the frames, with the camera's motion as x; ``seed`` feeds randomised policies."""
    x = sequence.motion().at(sequence.time_us)
    arrivals = messages(sequence.time_us, size_bytes, x - x[0])
    return Episode(arrivals, link).with_uniforms(np.random.Generator(np.random.PCG64(seed)))


def received(policy: str | Policy, one: Episode, capacity: int) -> tuple[int, ...]:
    """Return the indices of the frames that arrive, with a queue of ``capacity`` messages under ``policy``."""
    senders = sim.run(policies.get(policy), [one], capacity, motion_value())
    return tuple(metrics.received(senders, 0)["seq"].tolist())

"""A camera stream, or a robot's recording, over real or synthetic links."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.scenario.checks import check_value, is_number, natural, positive, rate
from bufgym.scenario.episode import Episode, Streams, unchecked_messages
from bufgym.traces import Motion, Trace
from bufgym.traces.workload import Workload


@dataclass(frozen=True)
class Uplink:
    """A camera stream over capacity traces.

    Frames arrive at ``rate_hz``, each moved within its period by up to ``jitter`` of it; sizes are log-normal with
    mean ``size_bytes`` and coefficient of variation ``size_cv`` (0: all equal). The link is one of ``traces``, chosen
    at random, times ``scale`` (one of them at random where several are given), from a random offset on. ``motion``:
    recordings that give x, from a random offset on; without one, x is the frame index.

    ``workload``: a robot's recording, played as it is, in place of the stream that ``rate_hz``, ``jitter``,
    ``size_bytes``, ``size_cv`` and ``duration_s`` describe. All its topics share the queue; it gives x if it has one.
    """

    traces: tuple[Trace, ...] = ()
    motion: tuple[Motion, ...] = ()
    rate_hz: float = 30.0
    jitter: float = 0.1
    size_bytes: int = 230_000
    size_cv: float = 0.0
    duration_s: float = 30.0
    scale: tuple[float, ...] = (1.0,)
    random_offset: bool = True
    link_offset_s: tuple[float, float] | None = None
    """Where on the trace an episode begins, at random from..to, s; None: anywhere."""
    propagation_us: int = 20_000
    value: Value = field(default_factory=lambda: qoi.exponential(math.exp(-1)))
    workload: Workload | None = None

    def __post_init__(self) -> None:
        for name, kind, what in (
            ("traces", Trace, "a bufgym.traces Trace"),
            ("motion", Motion, "a bufgym.traces Motion"),
            ("scale", int | float, "a number > 0"),
        ):
            given = getattr(self, name)
            if isinstance(given, str) or not isinstance(given, Sequence):
                given = (given,)
            for item in given:
                if not isinstance(item, kind):
                    raise BufgymError(f"{name}: {item!r} is not {what}")
            object.__setattr__(self, name, tuple(given))
        if not self.traces:
            raise BufgymError("traces: an uplink needs at least one bandwidth trace")
        if not self.scale or not all(math.isfinite(s) and s > 0 for s in self.scale):
            raise BufgymError(f"scale = {self.scale}: every factor must be a number > 0")
        positive(self, "size_bytes", "duration_s")
        rate(self.rate_hz)
        natural("propagation_us", self.propagation_us)
        if self.size_bytes < 1:
            raise BufgymError(f"size_bytes = {self.size_bytes}: must be at least 1")
        for name in ("jitter", "size_cv"):
            if not is_number(getattr(self, name)):
                raise BufgymError(f"{name} = {getattr(self, name)!r}: must be a number")
        if not 0 <= self.jitter <= 1:
            raise BufgymError(f"jitter = {self.jitter}: must lie between 0 and 1 (of a period)")
        if not 0 <= self.size_cv <= 10:
            raise BufgymError(f"size_cv = {self.size_cv}: must lie between 0 and 10")
        if self.link_offset_s is not None and not (
            len(self.link_offset_s) == 2 and 0 <= self.link_offset_s[0] <= self.link_offset_s[1] < math.inf
        ):
            raise BufgymError(f"link_offset_s = {self.link_offset_s}: must be (from, to) with 0 <= from <= to, s")
        if self.workload is not None and not isinstance(self.workload, Workload):
            raise BufgymError(f"workload: {self.workload!r} is not a bufgym.traces Workload")
        if self.workload is not None and self.workload.x is not None and self.motion:
            raise BufgymError(f"motion: workload {self.workload.name!r} has an x of its own")
        if not 1 <= self.max_messages <= 10**7:
            raise BufgymError(f"rate_hz x duration_s = {self.max_messages} messages: must lie between 1 and 10000000")
        check_value(self)

    @property
    def topics(self) -> tuple[Topic, ...]:
        return ()  # one queue

    @property
    def max_messages(self) -> int:
        return round(self.rate_hz * self.duration_s) if self.workload is None else len(self.workload)

    @functools.cached_property
    def _links(self) -> tuple[Trace, ...]:
        return tuple(trace if s == 1 else trace.scaled(s) for trace in self.traces for s in self.scale)

    def draw(self, streams: Streams) -> Episode:
        arrivals = self._stream(streams.arrival) if self.workload is None else _replayed(self.workload)
        self.move(arrivals, streams.arrival)
        trace = self._links[int(streams.link.integers(len(self._links)))]
        offset = 0
        if self.random_offset:
            first, last = self.link_offset_s or (0.0, trace.duration_us / 1e6)
            offset = int(streams.link.integers(round(first * 1e6), max(round(last * 1e6), 1 + round(first * 1e6))))
        return Episode(arrivals, Link(trace, offset, int(self.propagation_us)))

    def move(self, arrivals: NDArray[Any], rng: np.random.Generator) -> None:
        """Give these messages the x of one of the recordings, if there are any, from a place drawn at random."""
        if self.motion:
            motion = self.motion[int(rng.integers(len(self.motion)))]
            start = int(rng.integers(motion.time_us[-1])) if self.random_offset else 0
            x = motion.at(arrivals["arrival_us"] + start)
            arrivals["x"] = x - x[0]

    def _stream(self, rng: np.random.Generator) -> NDArray[Any]:
        """MESSAGE[n] of the camera, x being the frame index."""
        n, period_us = self.max_messages, 1e6 / self.rate_hz
        moved = np.arange(n, dtype=np.float64)
        if self.jitter:
            moved += self.jitter * rng.random(n)
        arrival_us = (moved * period_us).astype(np.int64)
        arrival_us -= arrival_us[0]
        size: NDArray[np.int64] | int = int(self.size_bytes)
        if self.size_cv:
            spread = math.sqrt(math.log1p(self.size_cv**2))
            drawn = self.size_bytes * np.exp(spread * rng.standard_normal(n) - spread**2 / 2)
            size = np.maximum(1, np.rint(drawn)).astype(np.int64)
        return unchecked_messages(arrival_us, size, None)


def _replayed(workload: Workload) -> NDArray[Any]:
    """MESSAGE[n] of a recording."""
    arrivals = unchecked_messages(workload.arrival_us, workload.size_bytes, workload.x)
    arrivals["topic"] = workload.topic
    return arrivals

"""A camera stream, or a robot's recording, over real or synthetic links."""

import functools
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bufgym import traces
from bufgym.model import qoi
from bufgym.model.checks import flag, whole
from bufgym.model.link import MAX_TIME_US, Link
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.scenario.arrivals import even, messages, read_only
from bufgym.scenario.checks import as_tuple, check_sizes, check_stream, check_value, recordings, up_to
from bufgym.scenario.draws import SIZES, derived_generator, place, place_link, shipped, sizes, skip
from bufgym.scenario.episode import Episode, Streams
from bufgym.scenario.texts import how_rated, links_by_name, motions_by_name
from bufgym.traces import Motion, Trace
from bufgym.traces.generate.sizes import EQUAL, Moving, drawn
from bufgym.traces.trace import MAX_DURATION_S
from bufgym.traces.workload import Workload
from bufgym.utils.errors import BufgymError

_JITTER_HZ = 30.0
"""Reference rate. At any rate an episode leaves its stream where the jitter of so many messages a second does. So
motion and all later draws are the same for every ``rate_hz``, ``jitter``, ``sizes`` and ``size_cv``."""
_TIMES = 0  # Number of the generator ``derived_generator`` makes of the stream that draws the jitter of other rates


@dataclass(frozen=True)
class Uplink:
    """A camera stream over capacity traces.

    Frames arrive at ``rate_hz``. The link is one of ``traces``, chosen at random, times one of ``scale``, from a random
    offset on. x is one of the recordings in ``motion`` from a random offset on, or without one the frame index. Jitter,
    sizes and motion have draws of their own: one seed gives the same link and motion for other rates or sizes.

    A ``workload``, a robot's recording, is played as it is. It replaces the stream that ``rate_hz``, ``jitter``,
    ``size_bytes``, ``sizes``, ``size_cv`` and ``duration_s`` describe. Its topics share the queue; it may give x.

    Text in place of an object is read as on the command line: ``traces="lte-synthetic-0"`` (a shipped name or a file,
    several with commas between, or a list of them), ``motion="drive-0"`` (or "none"), ``value="saturating:0.5"``,
    ``workload="drive.mcap"``.
    """

    traces: tuple[Trace, ...] = ()
    """Links; one of them carries an episode."""
    motion: tuple[Motion, ...] = ()
    """Recordings that give x; without them x is the frame index."""
    rate_hz: float = 30.0
    """Messages a second."""
    jitter: float = 0.1
    """Largest shift of a message within its period, as a fraction of the period."""
    size_bytes: int = 230_000
    """Mean bytes of a message."""
    size_cv: float = 0.0
    """Coefficient of variation of independent log-normal sizes; 0 for equal sizes."""
    sizes: str = EQUAL
    """Law of the sizes: equal, jpeg, gop, depth-colour, motion or recorded:NAME (``bufgym.traces.generate.sizes``)."""
    duration_s: float = 30.0
    """Length of an episode's arrivals, s."""
    tells_duration: bool = False
    """Whether the sender is told ``duration_s``, or a workload's length, beforehand."""
    scale: tuple[float, ...] = (1.0,)
    """Factors on the link's capacity; one of them is drawn for an episode."""
    random_offset: bool = True
    """Whether link and motion begin at a random place; otherwise they begin at the start."""
    link_offset_s: tuple[float, float] | None = None
    """Range of the episode's random offset on the trace, s; None for anywhere."""
    propagation_us: int = 20_000
    """Time from a message's last byte on the link to the server, us."""
    value: Value = field(default_factory=lambda: qoi.exponential(math.exp(-1)))
    """V for the QoI."""
    workload: Workload | None = None
    """A recording to play; None for the stream."""

    topics: ClassVar[tuple[Topic, ...]] = ()
    """Empty: one queue."""
    """Factor on rewards that brings a default episode's return between 1 and 10."""

    def __post_init__(self) -> None:
        recordings(self)
        as_tuple(self, "scale", int | float, "a number > 0")
        if not self.traces:
            raise BufgymError("traces: an uplink needs at least one bandwidth trace")
        if not self.scale or not all(math.isfinite(s) and s > 0 for s in self.scale):
            raise BufgymError(f"scale = {self.scale}: every factor must be a number > 0")
        check_stream(self)
        flag("tells_duration", self.tells_duration)
        flag("random_offset", self.random_offset)
        check_sizes(self, bool(self.motion) or self.workload is not None)
        up_to("duration_s", self.duration_s, MAX_DURATION_S)
        whole("propagation_us", self.propagation_us, 0, MAX_TIME_US)
        if self.size_bytes < 1:
            raise BufgymError(f"size_bytes = {self.size_bytes}: must be at least 1")
        if self.link_offset_s is not None and not (
            len(self.link_offset_s) == 2 and 0 <= self.link_offset_s[0] <= self.link_offset_s[1] <= MAX_DURATION_S
        ):
            raise BufgymError(
                f"link_offset_s = {self.link_offset_s}: must be (from, to) with 0 <= from <= to <= {MAX_DURATION_S}, s"
            )
        if isinstance(self.workload, str | Path):
            object.__setattr__(self, "workload", traces.read_workload(self.workload))
        if self.workload is not None and not isinstance(self.workload, Workload):
            raise BufgymError(f"workload: {self.workload!r} is not a bufgym.traces Workload")
        if self.workload is not None and self.workload.x is not None and self.motion:
            raise BufgymError(f"motion: workload {self.workload.name!r} has an x of its own")
        if not 1 <= self.max_messages <= 10**7:
            raise BufgymError(f"rate_hz x duration_s = {self.max_messages} messages: must lie between 1 and 10000000")
        check_value(self)

    @property
    def max_messages(self) -> int:
        """Arrivals of an episode."""
        return round(self.rate_hz * self.duration_s) if self.workload is None else len(self.workload)

    @property
    def about(self) -> str:
        """What is sent over which links, and how it is rated."""
        links = links_by_name(self.traces, self.scale[0])
        source = f"from {motions_by_name(self.motion)}" if self.motion else "as recorded"
        if self.workload is None:
            sent = f"{self.rate_hz:g} messages/s of {self.size_bytes} bytes for {self.duration_s:g} s over {links}"
            places = "from random offsets" if self.random_offset else "from their start"
            x = f"the camera's motion, in fields of view, {source}" if self.motion else "the frame index"
        else:
            shared = "; all topics share one queue" if len(self.workload.topics) > 1 else ""
            sent = f"Played over {links}"
            places = ("from random places" if self.random_offset else "from the trace's start") + shared
            moves = self.motion or self.workload.x is not None
            x = f"the motion, {source}, in fields of view" if moves else "the number of the message"
        return f"{sent}, {places}.\n{how_rated(self)}\nx is {x}."

    @functools.cached_property
    def _links(self) -> tuple[Trace, ...]:
        return tuple(trace.scaled(factor) for trace in self.traces for factor in self.scale)

    def draw(self, streams: Streams) -> Episode:
        """Draw one episode."""
        if self.workload is None:
            arrivals = self.stream(streams.arrival)
        else:
            arrivals = messages(self.workload.arrival_us, self.workload.size_bytes, self.workload.x)
            arrivals["topic"] = self.workload.topic
            self._move(arrivals, streams.arrival)
        trace, offset_us = place_link(self._links, streams.link, self.random_offset, self.link_offset_s)
        ends_us = None
        if self.tells_duration:
            ends_us = round(1e6 * self.duration_s) if self.workload is None else int(arrivals["arrival_us"][-1])
        return Episode(read_only(arrivals), Link(trace, offset_us, int(self.propagation_us)), ends_us=ends_us)

    def stream(
        self, rng: np.random.Generator, robot: int = 0, arrival_us: NDArray[np.int64] | None = None
    ) -> NDArray[Any]:
        """MESSAGE[n] of the camera, or of a fleet's robot; at these times if they are given."""
        own = derived_generator(rng, SIZES + robot) if self.size_cv or self.sizes != EQUAL else rng
        if arrival_us is None:
            arrivals = even(self.max_messages, 1e6 / self.rate_hz, self.jitter, self._jitter(rng), int(self.size_bytes))
        else:
            arrivals = messages(arrival_us, int(self.size_bytes))
        moving = self._move(arrivals, rng)
        if self.sizes != EQUAL:
            along = moving and Moving(moving[0], arrivals["arrival_us"] + moving[1])
            arrivals["size_bytes"] = drawn(self.sizes, len(arrivals), self.size_bytes, own, along)
        elif self.size_cv:
            arrivals["size_bytes"] = sizes(len(arrivals), self.size_bytes, self.size_cv, own)
        return arrivals

    def _move(self, arrivals: NDArray[Any], rng: np.random.Generator) -> tuple[Motion, int] | None:
        """Give these messages the x of a recording, if there are any, from a random place on."""
        if not self.motion:
            return None
        motion, start_us = place(self.motion, rng, self.random_offset)
        x = arrivals["x"]
        motion.follow(arrivals["arrival_us"], start_us, x)
        x -= x[0]
        return motion, start_us

    def _jitter(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """float64[n], uniform draws for the jitter of the frames; empty without jitter."""
        n, jitter_draws = self.max_messages, round(_JITTER_HZ * self.duration_s)
        if self.jitter and n == jitter_draws:
            return rng.random(n)
        draws = derived_generator(rng, _TIMES).random(n) if self.jitter else np.zeros(0)
        skip(rng, jitter_draws)
        return draws


RGBD_BYTES = 1280 * 720 * (3 + 2)
"""Bytes of an uncompressed frame of 1280 x 720, as from a RealSense D455: three of colour and two of depth a pixel."""


def uplink_over_lte() -> Uplink:
    """An RGB-D camera on a driving robot over the shipped LTE links, which carry about two of its 30 frames a second.

    V(1) = 0.95: a frame that shares nothing with its predecessor is worth nearly a whole one. Link and V were chosen so
    that the choice matters: Drop Oldest loses about 10 % of the clairvoyant's H, AFR about 7 %.
    """
    return Uplink(**shipped(), size_bytes=RGBD_BYTES, value=qoi.exponential(0.05))

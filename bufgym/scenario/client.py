"""A robot's client: many topics over one uplink, as a Robofleet client has them.

Each ``Stream`` publishes one topic; the ``Client`` sends them all over one link, with at most n_T messages in flight.
``robofleet_example`` is the client configuration that Robofleet ships as its example, with what it leaves open
(publish rates, sizes) filled in; ``read_client`` reads a configuration of your own.
"""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import traces
from bufgym.errors import BufgymError
from bufgym.kernel import records
from bufgym.model import qoi
from bufgym.model.buffer import MESSAGE
from bufgym.model.link import Link
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic, check_topics, check_window
from bufgym.scenario.checks import above_0, check_value, is_number, natural, positive, rate
from bufgym.scenario.episode import Episode, Streams
from bufgym.traces import Motion, Trace

ENCODINGS = ("ros", "json")
"""What rivals send instead of Robofleet's flatbuffers (``Policy.client.encoding``)."""


@dataclass(frozen=True)
class Stream:
    """What publishes on one topic: ``rate_hz`` messages a second of ``size_bytes`` each."""

    topic: Topic
    rate_hz: float
    size_bytes: int
    jitter: float = 0.1
    """Each message is moved within its period by up to this part of it."""
    size_cv: float = 0.0
    """Coefficient of variation of the sizes, which are log-normal then."""
    moves: bool = False
    """Whether its x is the robot's motion; else time, in periods of its rate limit (or its own rate)."""
    encodings: Mapping[str, int] = field(default_factory=dict)
    """Mean bytes in other encodings, by name; the same as ``size_bytes`` where not given."""

    def __post_init__(self) -> None:
        if not isinstance(self.topic, Topic):
            raise BufgymError(f"stream: {self.topic!r} is not a bufgym.model.topics.Topic")
        try:
            rate(self.rate_hz)
            above_0("size_bytes", self.size_bytes)
            natural("size_bytes", self.size_bytes)
            for name, most in (("jitter", 1), ("size_cv", 10)):
                if not is_number(getattr(self, name)) or not 0 <= getattr(self, name) <= most:
                    raise BufgymError(f"{name} = {getattr(self, name)!r}: must lie between 0 and {most}")
            if not isinstance(self.moves, bool):
                raise BufgymError(f"moves = {self.moves!r}: must be true or false")
            for name, size in self.encodings.items():
                if name not in ENCODINGS:
                    raise BufgymError(f"unknown encoding {name!r}; known: {', '.join(ENCODINGS)}")
                above_0(f"bytes in {name}", size)
        except BufgymError as error:
            raise BufgymError(f"topic {self.topic.name!r}: {error}") from None

    @property
    def unit_hz(self) -> float:
        """How many steps of x a second are, where x is time."""
        return min(self.rate_hz, self.topic.rate_limit_hz or self.rate_hz)


@dataclass(frozen=True)
class Client:
    """Streams over one uplink: its link is one of ``traces`` from a random offset, times ``scale``."""

    streams: tuple[Stream, ...]
    traces: tuple[Trace, ...]
    motion: tuple[Motion, ...] = ()
    duration_s: float = 60.0
    scale: float = 1.0
    random_offset: bool = True
    window: int = 1
    """n_T: Robofleet's paper has 1 in its experiments, the released client 5 by default."""
    propagation_us: int = 20_000
    round_trip_us: int | None = None
    """From a message's crossing to its pong; None: twice the propagation delay."""
    consumers: int = 1
    """How many want each message."""
    value: Value = field(default_factory=lambda: qoi.exponential(0.618))
    """V of topics that have none of their own."""

    def __post_init__(self) -> None:
        for name, kind, what in (
            ("streams", Stream, "a bufgym.scenario.Stream"),
            ("traces", Trace, "a bufgym.traces Trace"),
            ("motion", Motion, "a bufgym.traces Motion"),
        ):
            given = getattr(self, name)
            given = given if isinstance(given, Sequence) else (given,)
            for item in given:
                if not isinstance(item, kind):
                    raise BufgymError(f"{name}: {item!r} is not {what}")
            object.__setattr__(self, name, tuple(given))
            if not given and name != "motion":
                raise BufgymError(f"{name}: a client needs at least one")
        check_topics(self.topics)
        positive(self, "duration_s", "scale")
        check_window(self.window)
        natural("propagation_us", self.propagation_us)
        natural("round_trip_us", self.ack_delay_us)
        if natural("consumers", self.consumers) == 0:
            raise BufgymError("consumers = 0: must be a whole number >= 1")
        check_value(self)
        for stream in self.streams:
            if stream.moves and not self.motion:
                raise BufgymError(f"topic {stream.topic.name!r}: moves, but the client has no motion recording")
        total = self.max_messages * self.consumers
        if not 1 <= total <= 10**7:
            copies = f", with a copy for each of {self.consumers} consumers" if self.consumers > 1 else ""
            raise BufgymError(f"{total} messages in all{copies}: must lie between 1 and 10000000")

    @property
    def topics(self) -> tuple[Topic, ...]:
        return tuple(stream.topic for stream in self.streams)

    @property
    def max_messages(self) -> int:
        return sum(self._count(stream) for stream in self.streams)

    @property
    def ack_delay_us(self) -> int:
        """From a message's crossing to its pong, us."""
        return 2 * self.propagation_us if self.round_trip_us is None else self.round_trip_us

    def _count(self, stream: Stream) -> int:
        return max(1, round(stream.rate_hz * self.duration_s))

    @functools.cached_property
    def _links(self) -> tuple[Trace, ...]:
        return tuple(trace if self.scale == 1 else trace.scaled(self.scale) for trace in self.traces)

    def draw(self, streams: Streams) -> Episode:
        rng = streams.arrival
        motion, start = None, 0
        if self.motion:
            motion = self.motion[int(rng.integers(len(self.motion)))]
            start = int(rng.integers(motion.time_us[-1])) if self.random_offset else 0
        columns = [self._published(k, stream, motion, start, rng) for k, stream in enumerate(self.streams)]
        times, numbers, sizes, xs = (np.concatenate(column) for column in zip(*columns, strict=True))
        order = np.argsort(times, kind="stable")
        arrivals = records(len(times), MESSAGE)
        arrivals["seq"] = np.arange(len(times))
        arrivals["arrival_us"] = times[order] - times[order[0]]
        arrivals["topic"], arrivals["size_bytes"], arrivals["x"] = numbers[order], sizes[order], xs[order]
        trace = self._links[int(streams.link.integers(len(self._links)))]
        offset = int(streams.link.integers(trace.duration_us)) if self.random_offset else 0
        return Episode(
            arrivals,
            Link(trace, offset, int(self.propagation_us)),
            window=self.window,
            ack_delay_us=self.ack_delay_us,
            encodings={name: self._resized(arrivals, name) for name in ENCODINGS},
            consumers=self.consumers,
        )

    def _published(
        self, number: int, stream: Stream, motion: Motion | None, start: int, rng: np.random.Generator
    ) -> tuple[NDArray[Any], ...]:
        """(time, topic, bytes, x) of one stream's messages; streams begin at moments of their own."""
        n, period_us = self._count(stream), 1e6 / stream.rate_hz
        phase = rng.random() if self.random_offset else 0.0
        time_us = ((np.arange(n) + phase + stream.jitter * rng.random(n)) * period_us).astype(np.int64)
        time_us.sort()
        size = np.full(n, stream.size_bytes, np.int64)
        if stream.size_cv:
            spread = math.sqrt(math.log1p(stream.size_cv**2))
            drawn = stream.size_bytes * np.exp(spread * rng.standard_normal(n) - spread**2 / 2)
            size = np.maximum(1, np.rint(drawn)).astype(np.int64)
        if stream.moves and motion is not None:
            x = np.asarray(motion.at(time_us + start), np.float64)
        else:
            x = np.asarray(time_us * (stream.unit_hz / 1e6), np.float64)
        return time_us, np.full(n, number, np.int64), size, x - x[0]

    def _resized(self, arrivals: NDArray[Any], encoding: str) -> NDArray[np.int64]:
        """The messages' bytes in another encoding: each by its topic's ratio."""
        ratios = np.array(
            [stream.encodings.get(encoding, stream.size_bytes) / stream.size_bytes for stream in self.streams]
        )
        resized: NDArray[np.int64] = np.rint(arrivals["size_bytes"] * ratios[arrivals["topic"]]).astype(np.int64)
        return np.maximum(1, resized)


# --- configurations --------------------------------------------------------------------------------------------------


def robofleet_example() -> tuple[Stream, ...]:
    """The topics of Robofleet's example client configuration.

    Priorities and rate limits are those of the example (FACTS: localization 10 Hz p20; odometry 15 Hz p20; laser scans
    15 Hz p2; point cloud and images 10 Hz p1; visualisation 10 Hz p2; status 1 Hz; subscriptions no_drop). What it
    leaves open is assumed: publish rates as common drivers have them, sizes as Table I has them or as such messages
    encode, deadlines, and what x is.
    """
    fast = qoi.exponential(0.618)
    view = qoi.exponential(math.exp(-1))

    def stream(
        name: str, hz: float, size: int, ros: int, json: int, *, moves: bool = False, cv: float = 0.0, **topic: Any
    ) -> Stream:
        rules = Topic(name, value=view if moves else fast, **topic)
        return Stream(rules, hz, size, size_cv=cv, moves=moves, encodings={"ros": ros, "json": json})

    return (
        stream("localization", 20, 240, 75, 318, priority=20, rate_limit_hz=10, deadline_s=0.25),
        stream("odometry", 40, 960, 713, 1_084, priority=20, rate_limit_hz=15, deadline_s=0.25),
        stream("scan", 15, 7_328, 7_260, 28_000, priority=2, rate_limit_hz=15, deadline_s=0.5),
        stream("visualization", 10, 15_000, 14_800, 53_000, priority=2, rate_limit_hz=10, cv=0.5, deadline_s=1.0),
        stream("pointcloud", 10, 160_344, 160_111, 562_376, moves=True, rate_limit_hz=10, deadline_s=1.0),
        stream("image", 30, 75_224, 75_188, 267_650, moves=True, rate_limit_hz=10, cv=0.2, deadline_s=1.0),
        stream("status", 1, 156, 42, 162),
        stream("subscriptions", 1, 600, 500, 1_200, no_drop=True),
    )


_TOPIC_KEYS = {f.name for f in fields(Topic)} - {"value"}
_STREAM_KEYS = {"rate_hz", "size_bytes", "jitter", "size_cv", "moves"}
_CLIENT_KEYS = {"window", "propagation_us", "round_trip_us", "consumers", "duration_s"}


def read_client(path: str | Path, **parameters: Any) -> Client:
    """A client from a TOML file: ``[[topic]]`` tables with what ``Topic`` and ``Stream`` take, ``window`` and the like.

    A topic's ``value`` is written as on the command line (``"exponential:0.618"``), its sizes in other encodings as
    ``encodings = {json = 28000}``. ``parameters``: what the file does not have, such as ``traces`` and ``motion``;
    without ``traces`` the shipped LTE links and motions, as ``bufgym topics --config`` has them.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise BufgymError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise BufgymError(f"{path}: no configuration that can be read: {why}") from None
    try:
        given = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BufgymError(f"{path}: {error}") from None
    tables = given.pop("topic", [])
    try:
        unknown = sorted(set(given) - _CLIENT_KEYS)
        if unknown:
            raise BufgymError(f"unknown key {unknown[0]!r}; known: topic, {', '.join(sorted(_CLIENT_KEYS))}")
        if not isinstance(tables, list) or not tables:
            raise BufgymError("needs at least one [[topic]]")
        streams = tuple(_stream(table) for table in tables)
        world = {} if "traces" in parameters else _shipped()
        return Client(streams, **{**given, **world, **parameters})
    except BufgymError as error:
        raise BufgymError(f"{path}: {error}") from None


def _stream(table: Mapping[str, Any]) -> Stream:
    name = table.get("name", "without a name") if isinstance(table, Mapping) else table
    if not isinstance(table, Mapping):
        raise BufgymError(f"topic = {table!r}: must be a [[topic]] table")
    known = _TOPIC_KEYS | _STREAM_KEYS | {"value", "encodings"}
    for key in table:
        if key not in known:
            raise BufgymError(f"topic {name!r}: unknown key {key!r}; known: {', '.join(sorted(known))}")
    for key in ("name", "rate_hz", "size_bytes"):
        if key not in table:
            raise BufgymError(f"topic {name!r}: {key} is missing")
    topic = {key: table[key] for key in table if key in _TOPIC_KEYS}
    if "value" in table:
        try:
            topic["value"] = qoi.parse(str(table["value"]))
        except BufgymError as error:
            raise BufgymError(f"topic {name!r}: {error}") from None
    encodings = table.get("encodings", {})
    if not isinstance(encodings, Mapping):
        raise BufgymError(f"topic {name!r}: encodings = {encodings!r}: must be a table of bytes by encoding")
    return Stream(Topic(**topic), encodings=encodings, **{key: table[key] for key in table if key in _STREAM_KEYS})


def client_over_lte() -> Client:
    """The example client over the shipped synthetic LTE links at a quarter of their capacity."""
    return Client(robofleet_example(), **_shipped(), scale=0.25)


def _shipped() -> dict[str, Any]:
    """The synthetic links and motions that come with bufgym."""
    names = traces.shipped()
    return {
        "traces": tuple(traces.load(name) for name in names if name.startswith("lte-")),
        "motion": tuple(traces.load_motion(name) for name in names if name.startswith("drive-")),
    }

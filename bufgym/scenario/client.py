"""A robot's client: many topics over one uplink, like a Robofleet client.

Each ``Stream`` publishes one topic. The ``Client`` sends them all over one link, with at most n_T messages in flight.
There are Robofleet's example client, and clients from TOML files.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.model import qoi
from bufgym.model.checks import above_0, check_window, whole
from bufgym.model.link import MAX_TIME_US, Link
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic, check_topics
from bufgym.scenario.arrivals import messages, read_only
from bufgym.scenario.checks import as_tuple, check_sizes, check_stream, check_value, recordings, up_to
from bufgym.scenario.draws import SIZES, derived_generator, place, place_link, shipped, sizes
from bufgym.scenario.episode import Episode, Streams
from bufgym.scenario.texts import links_by_name
from bufgym.traces import Motion, Trace
from bufgym.traces.generate.sizes import EQUAL, Moving, drawn
from bufgym.traces.trace import MAX_DURATION_S
from bufgym.traces.workload import MAX_MESSAGE_BYTES
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.files import check_keys, read_toml

ENCODINGS = ("ros", "json")  # Encodings of rivals, in place of Robofleet's flatbuffers (``Policy.client.encoding``)


@dataclass(frozen=True)
class Stream:
    """A publisher on one topic: ``rate_hz`` messages a second of ``size_bytes`` each."""

    topic: Topic
    """Its name and the rules for its messages."""
    rate_hz: float
    """Messages a second."""
    size_bytes: int
    """Mean bytes of a message."""
    jitter: float = 0.1
    """Largest shift of a message within its period, as a fraction of the period."""
    size_cv: float = 0.0
    """Coefficient of variation of independent log-normal sizes; 0 for equal sizes."""
    sizes: str = EQUAL
    """Law of the sizes (``bufgym.traces.generate.sizes``)."""
    moves: bool = False
    """Whether its x is the robot's motion; otherwise x is time, in periods of its rate limit or its own rate."""
    encodings: Mapping[str, int] = field(default_factory=dict)
    """Mean bytes in other encodings, by name; ``size_bytes`` for encodings not given."""

    def __post_init__(self) -> None:
        if not isinstance(self.topic, Topic):
            raise BufgymError(f"stream: {self.topic!r} is not a bufgym.model.topics.Topic")
        try:
            check_stream(self)
            check_sizes(self, self.moves)
            whole("size_bytes", self.size_bytes)
            if not isinstance(self.moves, bool):
                raise BufgymError(f"moves = {self.moves!r}: must be true or false")
            for name, size in self.encodings.items():
                if name not in ENCODINGS:
                    raise unknown("encoding", name, ENCODINGS)
                up_to(f"bytes in {name}", size, MAX_MESSAGE_BYTES)
        except BufgymError as error:
            raise BufgymError(f"topic {self.topic.name!r}: {error}") from None

    @property
    def unit_hz(self) -> float:
        """Steps of x a second, if x is time."""
        return min(self.rate_hz, self.topic.rate_limit_hz or self.rate_hz)

    def count(self, duration_s: float) -> int:
        """Messages in so many seconds, at least one."""
        return max(1, round(self.rate_hz * duration_s))


@dataclass(frozen=True)
class Client:
    """Streams over one uplink: its link is one of ``traces`` from a random offset, times ``scale``."""

    streams: tuple[Stream, ...]
    """The streams; topic k of an episode belongs to stream k."""
    traces: tuple[Trace, ...]
    """Links; one of them carries an episode."""
    motion: tuple[Motion, ...] = ()
    """Recordings that give x to the streams that move."""
    duration_s: float = 60.0
    """Length of an episode's arrivals, s."""
    scale: float = 1.0
    """Factor on the link's capacity."""
    random_offset: bool = True
    """Whether links, motion and streams begin at random places; otherwise they begin at the start."""
    window: int = 1
    """n_T: 1 in the experiments of Robofleet's paper, 5 by default in the released client."""
    propagation_us: int = 20_000
    """Time from a message's last byte on the link to the server, us."""
    round_trip_us: int | None = None
    """Time from a message's last byte on the link to its ack, us; None for twice the propagation delay."""
    consumers: int = 1
    """Receivers of each message."""
    sizes: str = EQUAL
    """Law of the sizes of all streams that move, such as cameras, in place of their own; equal for their own."""
    value: Value = field(default_factory=lambda: qoi.exponential(0.618))
    """V of topics that have none of their own."""

    """Factor on rewards that brings a default episode's return between 1 and 10."""

    def __post_init__(self) -> None:
        as_tuple(self, "streams", Stream, "a bufgym.scenario.Stream")
        recordings(self)
        for name in ("streams", "traces"):
            if not getattr(self, name):
                raise BufgymError(f"{name}: a client needs at least one")
        check_topics(self.topics)
        up_to("duration_s", self.duration_s, MAX_DURATION_S)
        above_0("scale", self.scale)
        check_window(self.window)
        whole("propagation_us", self.propagation_us, 0, MAX_TIME_US)
        whole("round_trip_us", self.ack_delay_us, 0, MAX_TIME_US)
        whole("consumers", self.consumers, 1)
        check_value(self)
        check_sizes(self, True)
        for stream in self.streams:
            if stream.moves and not self.motion:
                raise BufgymError(f"topic {stream.topic.name!r}: moves, but the client has no motion recording")
        total = self.max_messages * self.consumers
        if not 1 <= total <= 10**7:
            copies = f", with a copy for each of {self.consumers} consumers" if self.consumers > 1 else ""
            raise BufgymError(f"{total} messages in all{copies}: must lie between 1 and 10000000")

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The rules of its topics."""
        return tuple(stream.topic for stream in self.streams)

    @property
    def about(self) -> str:
        """Its number of topics, and its links."""
        topics = f"{len(self.topics)} topic{'' if len(self.topics) == 1 else 's'}"
        return f"{topics} over {links_by_name(self.traces, self.scale)}"

    @property
    def max_messages(self) -> int:
        """Arrivals of an episode."""
        return sum(stream.count(self.duration_s) for stream in self.streams)

    @property
    def ack_delay_us(self) -> int:
        """Time from a message's last byte on the link to its ack, us."""
        return 2 * self.propagation_us if self.round_trip_us is None else self.round_trip_us

    @functools.cached_property
    def _links(self) -> tuple[Trace, ...]:
        return tuple(trace.scaled(self.scale) for trace in self.traces)

    def draw(self, streams: Streams) -> Episode:
        """Draw one episode."""
        rng = streams.arrival
        moving = place(self.motion, rng, self.random_offset) if self.motion else None
        columns = [self._published(k, stream, moving, rng) for k, stream in enumerate(self.streams)]
        times, numbers, sizes_bytes, xs = (np.concatenate(column) for column in zip(*columns, strict=True))
        order = np.argsort(times, kind="stable")
        arrivals = messages(times[order] - times[order[0]], sizes_bytes[order], xs[order])
        arrivals["topic"] = numbers[order]
        trace, offset_us = place_link(self._links, streams.link, self.random_offset)
        return Episode(
            read_only(arrivals),
            Link(trace, offset_us, int(self.propagation_us)),
            window=self.window,
            ack_delay_us=self.ack_delay_us,
            encodings={name: self._encoded_bytes(arrivals, name) for name in ENCODINGS},
            consumers=self.consumers,
        )

    def _published(
        self, number: int, stream: Stream, moving: tuple[Motion, int] | None, rng: np.random.Generator
    ) -> tuple[NDArray[Any], ...]:
        """Time, topic, bytes and x of one stream's messages; each stream begins at its own moment."""
        n, period_us = stream.count(self.duration_s), 1e6 / stream.rate_hz
        phase = rng.random() if self.random_offset else 0.0
        time_us = ((np.arange(n) + phase + stream.jitter * rng.random(n)) * period_us).astype(np.int64)
        time_us.sort()
        size = self._sizes(number, stream, moving and Moving(moving[0], time_us + moving[1]), n, rng)
        if stream.moves and moving is not None:
            motion, start_us = moving
            x = np.asarray(motion.at(time_us + start_us), np.float64)
        else:
            x = np.asarray(time_us * (stream.unit_hz / 1e6), np.float64)
        return time_us, np.full(n, number, np.int64), size, x - x[0]

    def _sizes(
        self, number: int, stream: Stream, moving: Moving | None, n: int, rng: np.random.Generator
    ) -> NDArray[np.int64]:
        """int64[n], bytes of one stream's messages; a law's own draws leave ``rng`` as it was without."""
        own = self.sizes if stream.moves and self.sizes != EQUAL else stream.sizes
        independent = sizes(n, stream.size_bytes, stream.size_cv, rng)
        if own == EQUAL:
            return independent
        return drawn(own, n, stream.size_bytes, derived_generator(rng, SIZES + number), moving)

    def _encoded_bytes(self, arrivals: NDArray[Any], encoding: str) -> NDArray[np.int64]:
        """int64[messages], the messages' bytes in another encoding, by the ratio of each topic."""
        ratios = np.array(
            [stream.encodings.get(encoding, stream.size_bytes) / stream.size_bytes for stream in self.streams]
        )
        size: NDArray[np.int64] = np.rint(arrivals["size_bytes"] * ratios[arrivals["topic"]]).astype(np.int64)
        return np.maximum(1, size)


def robofleet_example() -> tuple[Stream, ...]:
    """The topics of Robofleet's example client configuration.

    Priorities and rate limits are the example's: localization 10 Hz, priority 20; odometry 15 Hz, 20; laser scans 15
    Hz, 2; point cloud and images 10 Hz, 1; visualization 10 Hz, 2; status 1 Hz; subscriptions no_drop. The rest is
    assumed. Publish rates are common drivers' rates. Sizes come from the paper's Table I or from encoding such
    messages. Deadlines and the meaning of x are our choice.
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


def client_over_lte() -> Client:
    """The example client over the shipped synthetic LTE links at a quarter of their capacity."""
    return Client(robofleet_example(), **shipped(), scale=0.25)


_TOPIC_KEYS = {f.name for f in fields(Topic)} - {"value"}
_STREAM_KEYS = {"rate_hz", "size_bytes", "jitter", "size_cv", "sizes", "moves"}
_CLIENT_KEYS = {"window", "propagation_us", "round_trip_us", "consumers", "duration_s", "sizes"}


def read_client(path: str | Path, **parameters: Any) -> Client:
    """Read a client from a TOML file with ``[[topic]]`` tables for ``Topic`` and ``Stream``, ``window`` and the like.

    A topic's ``value`` has the form of the command line (``"exponential:0.618"``). Its sizes in other encodings look
    like ``encodings = {json = 28000}``. ``parameters`` add settings that the file lacks, such as ``traces`` and
    ``motion``. Without ``traces`` the client gets the shipped LTE links and motions.

    Raises BufgymError, one line that names the file, for a file that can't be read or breaks a rule.
    """
    try:
        settings = read_toml(path)
        tables = settings.pop("topic", [])
        check_keys(settings, _CLIENT_KEYS, "topic, ")
        if not isinstance(tables, list) or not tables:
            raise BufgymError("needs at least one [[topic]]")
        recordings = {} if "traces" in parameters else shipped()
        return Client(tuple(map(_stream, tables)), **{**settings, **recordings, **parameters})
    except BufgymError as error:
        raise error if str(error).startswith(f"{path}") else BufgymError(f"{path}: {error}") from None


def _stream(table: Any) -> Stream:
    if not isinstance(table, Mapping):
        raise BufgymError(f"topic = {table!r}: must be a [[topic]] table")
    topic = {key: table[key] for key in table if key in _TOPIC_KEYS}
    encodings = table.get("encodings", {})
    try:
        check_keys(table, _TOPIC_KEYS | _STREAM_KEYS | {"value", "encodings"})
        for key in ("name", "rate_hz", "size_bytes"):
            if key not in table:
                raise BufgymError(f"{key} is missing")
        if "value" in table:
            topic["value"] = qoi.parse(str(table["value"]))
        if not isinstance(encodings, Mapping):
            raise BufgymError(f"encodings = {encodings!r}: must be a table of bytes by encoding")
    except BufgymError as error:
        raise BufgymError(f"topic {table.get('name', 'without a name')!r}: {error}") from None
    return Stream(Topic(**topic), encodings=encodings, **{key: table[key] for key in table if key in _STREAM_KEYS})

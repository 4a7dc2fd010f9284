"""What Robofleet's Fig. 3 to 7 share: the messages, the programs that send them, and what became of each.

The paper [sikand2021robofleet] sends with n_T = 1 in its experiments; so do we. What it leaves open is an option of
each figure. Arrivals are jittered by up to a tenth of their period, which is what differs from run to run; every sender
meets the same ones.

With ``live`` the same messages go over real sockets (``on_sockets``), in the fewer and shorter runs of a figure's
``LIVE``. Left out of the simulation on purpose: TCP (a link that stands still is found again at once, unless a figure
takes a silence as option), the bytes of pings and pongs, encoding time, and whatever lies behind the server.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.benchmark.run import draw
from bufgym.model.topics import Topic
from bufgym.reproduce.figure import COLOURS, Figure, at_least_0, several, whole
from bufgym.reproduce.rows import Rows
from bufgym.scenario import Client, Stream
from bufgym.scenario.checks import above_0
from bufgym.traces import Trace

POINTS = 10_000
"""Of a PointCloud2, each of ``POINT_BYTES``; the paper gives no size."""
POINT_BYTES = 16
BYTES = {
    "LaserScan": (7_260, 7_328, 28_000),
    "CompressedImage": (75_188, 75_224, 267_650),
    "PoseStamped": (75, 240, 281),
}
"""Bytes as ROS binary, Robofleet flatbuffer and JSON: the paper's Table I, and for PoseStamped what robofleet-table1
has for ``ros1``, ``robofleet`` and ``json-numbers`` (the JSON that the paper's images have)."""
_CLOUD_EXTRA = (111, 344)
_CLOUD_JSON = 562_376 / POINTS
"""A PointCloud2 likewise, by robofleet-table1: bytes besides its points, and bytes of JSON a point."""

JITTER = 0.1
ROUND_TRIP_MS = 10.0
"""Our choice. With n_T = 1 it bounds the throughput: one message per (transmission + round trip)."""
QUEUE_SIZE = 10
"""Of a native ROS publisher, messages; our choice, as in ROS's own tutorials."""
MBIT = 125_000
"""Bytes/s in a Mbit/s."""


@dataclass(frozen=True)
class Program:
    """Who sends: a policy, and what its operator asks of the topics."""

    policy: str
    """Its name in ``bufgym.policies``."""
    label: str
    """What legends call it."""
    short: str
    """What tables call it."""
    colour: str
    marker: str
    all_no_drop: bool = False
    """Whether every topic is no_drop."""
    queued: bool = False
    """Whether each topic has a queue of its own, of ``queue_size`` messages."""

    @property
    def style(self) -> dict[str, Any]:
        """How this program's line is drawn."""
        return {"color": self.colour, "marker": self.marker, "markersize": 4.5, "linewidth": 1.4}


PROGRAMS = {
    "robofleet": Program("robofleet", "Robofleet, n_T = 1", "n_T = 1", COLOURS["afr"], "o"),
    "no-drop": Program("robofleet", "Robofleet, all no_drop", "no_drop", COLOURS["drop-oldest"], "s", all_no_drop=True),
    "no-drop-released": Program(
        "robofleet-released", "released, all no_drop", "released", COLOURS["orange"], "^", all_no_drop=True
    ),
    "rosbridge": Program("rosbridge", "rosbridge", "rosbridge", COLOURS["random"], "D"),
    "ros-native": Program("ros-native", "native ROS", "native ROS", COLOURS["pink"], "v", queued=True),
}
SHORT = {name: program.short for name, program in PROGRAMS.items()}


@dataclass(frozen=True)
class Sent:
    """What became of every message of one run, in order of arrival; arrays of shape [messages]."""

    topic: NDArray[np.int64]
    """Index of the message's stream."""
    consumer: NDArray[np.int64]
    """Whose copy it is, where the sender makes copies; else 0."""
    arrival_s: NDArray[np.float64]
    """At the sender."""
    received_s: NDArray[np.float64]
    """At the server; NaN for a message that was dropped."""

    @property
    def latency_s(self) -> NDArray[np.float64]:
        """From arrival at the sender to the server; NaN for a message that was dropped."""
        return self.received_s - self.arrival_s

    @property
    def received(self) -> Sent:
        """Those that reached the server, in the order in which they did."""
        in_order = np.argsort(self.received_s, kind="stable")  # NaN comes last
        return self._only(in_order[: int((~np.isnan(self.received_s)).sum())])

    def on(self, topic: int) -> Sent:
        """Those of one stream."""
        return self._only(np.flatnonzero(self.topic == topic))

    def between(self, from_s: float, until_s: float) -> Sent:
        """Those that arrived at the sender in this time."""
        return self._only(np.flatnonzero((from_s <= self.arrival_s) & (self.arrival_s < until_s)))

    def received_hz(self, until_s: float) -> float:
        """Messages a second that reached the server by ``until_s``."""
        return float((self.received_s <= until_s).sum() / until_s)

    def _only(self, kept: NDArray[np.intp]) -> Sent:
        return Sent(self.topic[kept], self.consumer[kept], self.arrival_s[kept], self.received_s[kept])

    def __len__(self) -> int:
        return len(self.arrival_s)


def stream(kind: str, rate_hz: float, *, points: int = POINTS, jitter: float = JITTER, **topic: Any) -> Stream:
    """What publishes messages of this kind; ``topic``: what ``Topic`` takes."""
    ros, flatbuffer, json = cloud_bytes(points) if kind == "PointCloud2" else BYTES[kind]
    return Stream(Topic(kind, **topic), rate_hz, flatbuffer, jitter=jitter, encodings={"ros": ros, "json": json})


def cloud_bytes(points: int) -> tuple[int, int, int]:
    """Bytes of a PointCloud2 as ROS binary, Robofleet flatbuffer and JSON."""
    whole(1, 10**7)("points", points)
    ros, flatbuffer = (points * POINT_BYTES + extra for extra in _CLOUD_EXTRA)
    return ros, flatbuffer, round(points * _CLOUD_JSON)


def send(
    name: str,
    streams: Sequence[Stream],
    link: Trace,
    duration_s: float,
    seed: int = 0,
    *,
    round_trip_ms: float = ROUND_TRIP_MS,
    queue_size: int = QUEUE_SIZE,
    consumers: int = 1,
    live: float = 0.0,
    watched_s: float = math.inf,
) -> Sent:
    """What becomes of the streams' messages when one of ``PROGRAMS`` sends them; ``link`` begins with the first.

    ``live``: they go over real sockets, so many times as fast; 0: they are simulated. ``watched_s``: what is received
    later does not matter, and live it is not waited for.
    """
    program = PROGRAMS[name]
    rules: dict[str, Any] = {"no_drop": True} if program.all_no_drop else {}
    if program.queued:
        rules = {"limit": queue_size, "no_drop": False}
    round_trip_us = round(round_trip_ms * 1000)
    client = Client(
        tuple(replace(s, topic=replace(s.topic, **rules)) for s in streams),
        (link,),
        duration_s=duration_s,
        random_offset=False,
        propagation_us=round_trip_us // 2,
        round_trip_us=round_trip_us,
        consumers=consumers,
    )
    # Room for all: a no_drop queue knows no limit.
    room = client.max_messages * consumers
    policy = policies.get(program.policy)
    senders = sim.run(policy, [draw(client, seed)], room, client.value, topics=client.topics)
    sender = senders.batch.senders[0]
    arrivals = np.asarray(senders.batch.arrivals[0])[: sender["arrivals"]]
    transmitted_us = np.asarray(senders.batch.log[0])[: sender["arrivals"]]["transmitted_us"]
    received_s = np.where(transmitted_us == sim.NEVER, np.nan, (transmitted_us + sender["propagation_us"]) / 1e6)
    if live:
        from bufgym.reproduce import on_sockets  # not for those who only simulate

        received_s = on_sockets.received_s(policy, senders, client.value, live, watched_s)
    consumer, topic = np.divmod(arrivals["topic"], len(streams))
    return Sent(topic, consumer, arrivals["arrival_us"] / 1e6, received_s)


@dataclass(frozen=True)
class ClientFigure(Figure):
    """A figure of programs that send the same topics over one link; the mean of ``runs`` runs."""

    round_trip_ms: float = ROUND_TRIP_MS
    """Half of it to the server, the whole from the end of a message's transmission to its pong."""
    runs: int = 5
    """Differ by arrival jitter."""
    live: float = 0.0
    """How much faster than in truth messages go over real sockets; 0: they are simulated."""

    RULES = {
        "live": at_least_0,
        "round_trip_ms": at_least_0,
        "queue_size": whole(),
        "queue_sizes": several(whole()),
        "rate_hz": above_0,
        "rates_hz": several(above_0),
        "mbit_per_s": above_0,
        "duration_s": above_0,
    }

    @functools.cached_property
    def watchers(self) -> list[Callable[[float], None]]:
        """Each is told after each run how long it took, s."""
        return []

    @functools.cached_property
    def played(self) -> dict[Any, Any]:
        """See ``played_once``."""
        return {}

    def send(
        self, name: str, streams: Sequence[Stream], link: Trace, duration_s: float, seed: int, **client: Any
    ) -> Sent:
        """``send`` with the figure's own options."""
        if "queue_size" not in client:
            client["queue_size"] = getattr(self, "queue_size", QUEUE_SIZE)
        sent = send(name, streams, link, duration_s, seed, round_trip_ms=self.round_trip_ms, live=self.live, **client)
        last_s = float(np.nanmax(sent.received_s, initial=duration_s))
        for told in self.watchers:
            told(min(last_s, max(duration_s, client.get("watched_s", math.inf))))
        return sent


Kind = TypeVar("Kind", bound=ClientFigure)
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def played_once(
    run: Callable[Concatenate[Kind, Arguments], Result],
) -> Callable[Concatenate[Kind, Arguments], Result]:
    """A run of a figure, which live takes its time: who asks for the same one again, such as a picture, is given it."""

    @functools.wraps(run)
    def once(figure: Kind, /, *arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        if not figure.live:
            return run(figure, *arguments, **named)
        key = arguments, tuple(named.items())
        if key not in figure.played:
            figure.played[key] = run(figure, *arguments, **named)
        result: Result = figure.played[key]
        return result

    return once


@dataclass(frozen=True)
class CloudFigure(ClientFigure):
    """A figure of one PointCloud2 topic."""

    points: int = POINTS
    """Of a cloud, 16 bytes each."""
    queue_size: int = QUEUE_SIZE
    """Of native ROS, messages."""


def p95(numbers: NDArray[np.float64]) -> float:
    """95th percentile; NaN of nothing."""
    return float(np.percentile(numbers, 95)) if len(numbers) else np.nan


def curves(axes: Any, rows: Rows, x: str, y: str, names: Sequence[str], **styles: Any) -> None:
    """The mean of column ``y`` against column ``x``: one line a sender; ``styles`` change every line."""
    for k, name in enumerate(names):
        means = {at: rows.mean(y, **{x: at}, sender=name) for at in rows.where(sender=name).distinct(x)}
        program = PROGRAMS[name]
        style = {**program.style, "markersize": 4 + k, "zorder": 3 - 0.1 * k, **styles}  # equal lines stay visible
        axes.plot(list(means), list(means.values()), label=program.label, **style)

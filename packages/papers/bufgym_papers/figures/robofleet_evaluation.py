"""Messages, sending programs and outcomes shared by Robofleet's Fig. 3 to 7.

See packages/papers/bufgym_papers/figures/README.md, "Robofleet's figures".
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.model.topics import Topic
from bufgym.scenario import Client, Stream
from bufgym.scenario.numbered import draw
from bufgym.traces import Trace
from bufgym_papers.figures.figure import COLOURS, Figure, at_least_0, whole
from bufgym_papers.figures.rows import FigureRows

POINTS = 10_000  # Points of a PointCloud2, each of ``POINT_BYTES``; the paper gives no size
POINT_BYTES = 16
BYTES = {
    "LaserScan": (7_260, 7_328, 28_000),
    "CompressedImage": (75_188, 75_224, 267_650),
    "PoseStamped": (75, 240, 281),
}
"""Bytes as ROS binary, Robofleet flatbuffer and JSON, from the paper's Table I. PoseStamped is not in it and comes from
the study robofleet-table1 with ``ros1``, ``robofleet`` and ``json-numbers``, the JSON of the paper's images."""
_CLOUD_EXTRA = (111, 344)
_CLOUD_JSON = 562_376 / POINTS
"""Bytes of a PointCloud2 besides its points, and its JSON bytes per point, both from robofleet-table1."""

JITTER = 0.1
ROUND_TRIP_MS = 10.0
"""Round trip, our choice. With n_T = 1 it limits throughput to one message per transmission plus round trip."""
QUEUE_SIZE = 10  # Queue of a native ROS publisher in messages, our choice after ROS's own tutorials
MBIT = 125_000  # Bytes/s in a Mbit/s
Run = TypeVar("Run")


@dataclass(frozen=True)
class SendingProgram:
    """A sending program: its policy and its operator's settings of the topics."""

    policy: str  # its name in ``bufgym.policies``
    label: str  # label in legends
    short: str  # label in tables
    colour: str
    marker: str
    all_no_drop: bool = False  # whether every topic is no_drop
    queued: bool = False  # whether each topic has a queue of its own, of ``queue_size`` messages

    @property
    def style(self) -> dict[str, Any]:
        return {"color": self.colour, "marker": self.marker, "markersize": 4.5, "linewidth": 1.4}


PROGRAMS = {
    "robofleet": SendingProgram("robofleet", "Robofleet, n_T = 1", "n_T = 1", COLOURS["afr"], "o"),
    "no-drop": SendingProgram(
        "robofleet", "Robofleet, all no_drop", "no_drop", COLOURS["drop-oldest"], "s", all_no_drop=True
    ),
    "no-drop-released": SendingProgram(
        "robofleet-released", "released, all no_drop", "released", COLOURS["orange"], "^", all_no_drop=True
    ),
    "rosbridge": SendingProgram("rosbridge", "rosbridge", "rosbridge", COLOURS["random"], "D"),
    "ros-native": SendingProgram("ros-native", "native ROS", "native ROS", COLOURS["pink"], "v", queued=True),
}
SHORT = {name: program.short for name, program in PROGRAMS.items()}


@dataclass(frozen=True)
class Sent:
    """Outcome of every message of one run, in order of arrival; arrays have shape [messages]."""

    topic: NDArray[np.int64]  # index of the message's stream
    consumer: NDArray[np.int64]  # consumer of this copy if the sender makes copies, otherwise 0
    arrival_s: NDArray[np.float64]  # arrival time at the sender
    received_s: NDArray[np.float64]  # receipt time at the server; NaN for a dropped message

    @property
    def latency_s(self) -> NDArray[np.float64]:
        """Time from arrival at the sender to receipt at the server; NaN for a dropped message."""
        return self.received_s - self.arrival_s

    @property
    def received(self) -> Sent:
        """Messages that reached the server, in order of receipt."""
        in_order = np.argsort(self.received_s, kind="stable")  # NaN comes last
        return self._only(in_order[: int((~np.isnan(self.received_s)).sum())])

    def on(self, topic: int) -> Sent:
        return self._only(np.flatnonzero(self.topic == topic))

    def between(self, from_s: float, until_s: float) -> Sent:
        """Select the messages that arrived at the sender in this time."""
        return self._only(np.flatnonzero((from_s <= self.arrival_s) & (self.arrival_s < until_s)))

    def _only(self, kept: NDArray[np.intp]) -> Sent:
        return Sent(self.topic[kept], self.consumer[kept], self.arrival_s[kept], self.received_s[kept])

    def __len__(self) -> int:
        return len(self.arrival_s)


def stream(kind: str, rate_hz: float, *, points: int = POINTS, jitter: float = JITTER, **topic: Any) -> Stream:
    """Make a stream of messages of this kind; ``topic`` holds fields of ``Topic``."""
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
    """Send the streams' messages with one of ``PROGRAMS``; ``link`` begins at the first message.

    ``live`` above 0 sends over real sockets, sped up by that factor; 0 simulates. Messages received after ``watched_s``
    do not matter, and a live run does not wait for them.
    """
    program = PROGRAMS[name]
    rules: dict[str, Any] = {"no_drop": True} if program.all_no_drop else {}
    if program.queued:
        rules = {"limit": queue_size, "no_drop": False}
    round_trip_us = round(round_trip_ms * 1000)
    ruled = tuple(replace(s, topic=replace(s.topic, **rules)) for s in streams)
    times: dict[str, Any] = {"propagation_us": round_trip_us // 2, "round_trip_us": round_trip_us}
    client = Client(ruled, (link,), duration_s=duration_s, random_offset=False, consumers=consumers, **times)
    # Room for all messages, because a no_drop queue has no limit.
    room = client.max_messages * consumers
    policy = policies.get(program.policy)
    senders = sim.run(policy, [draw(client, seed)], room, client.value, topics=client.topics)
    sender = senders.batch.senders[0]
    arrivals = np.asarray(senders.batch.arrivals[0])[: sender["arrivals"]]
    transmitted_us = np.asarray(senders.batch.log[0])[: sender["arrivals"]]["transmitted_us"]
    received_s = np.where(transmitted_us == sim.NEVER, np.nan, (transmitted_us + sender["propagation_us"]) / 1e6)
    if live:
        from bufgym_papers.figures import on_sockets  # not needed to simulate

        received_s = on_sockets.received_s(policy, senders, client.value, live, watched_s)
    consumer, topic = np.divmod(arrivals["topic"], len(streams))
    return Sent(topic, consumer, arrivals["arrival_us"] / 1e6, received_s)


@dataclass(frozen=True)
class ClientFigure(Figure):
    """A figure of programs that send the same topics over one link; values are means of ``runs`` runs."""

    round_trip_ms: float = ROUND_TRIP_MS
    """Time from the end of a message's transmission to its pong; half of it is the way to the server."""
    runs: int = 5  # number of runs, which differ by arrival jitter
    live: float = 0.0  # speed-up of a run on real sockets; 0 simulates

    RULES = {"live": at_least_0, "round_trip_ms": at_least_0}

    @functools.cached_property
    def watchers(self) -> list[Callable[[float], None]]:
        """Functions called after each run with its duration in s."""
        return []

    @functools.cached_property
    def played(self) -> dict[Any, Any]:
        """Results of live runs."""
        return {}

    def once(self, run: Callable[..., Run], *arguments: Any) -> Run:
        """Do a run of the figure; a live one is done once, because it is slow and the picture needs it again."""
        kept = self.played if self.live else {}
        if arguments not in kept:
            kept[arguments] = run(*arguments)
        return cast(Run, kept[arguments])

    def send(
        self, name: str, streams: Sequence[Stream], link: Trace, duration_s: float, seed: int, **client: Any
    ) -> Sent:
        client = {"queue_size": getattr(self, "queue_size", QUEUE_SIZE), "live": self.live, **client}
        sent = send(name, streams, link, duration_s, seed, round_trip_ms=self.round_trip_ms, **client)
        last_s = float(np.nanmax(sent.received_s, initial=duration_s))
        for watcher in self.watchers:
            watcher(min(last_s, max(duration_s, client.get("watched_s", math.inf))))
        return sent


@dataclass(frozen=True)
class CloudFigure(ClientFigure):
    """A figure of one PointCloud2 topic."""

    points: int = POINTS  # points of a cloud, 16 bytes each
    queue_size: int = QUEUE_SIZE  # queue of native ROS, messages


def p95(numbers: NDArray[np.float64]) -> float:
    return float(np.percentile(numbers, 95)) if len(numbers) else np.nan


def curves(axes: Any, rows: FigureRows, x: str, y: str, names: Sequence[str], **styles: Any) -> None:
    """Draw the mean of column ``y`` against column ``x``, one line per sender; ``styles`` apply to every line."""
    for k, name in enumerate(names):
        means = {at: rows.mean(y, **{x: at}, sender=name) for at in rows.where(sender=name).distinct(x)}
        program = PROGRAMS[name]
        style = {**program.style, "markersize": 4 + k, "zorder": 3 - 0.1 * k, **styles}  # equal lines stay visible
        axes.plot(list(means), list(means.values()), label=program.label, **style)

"""What Robofleet's Fig. 3 to 7 share: the messages, who sends them, and what became of each.

The paper sends with n_T = 1 in its experiments; so do we. What it leaves open is an argument of each figure. Arrivals
are jittered by up to a tenth of their period, which is what differs from run to run; every sender meets the same ones.

Left out on purpose: TCP (a link that stands still is found again at once, unless a figure takes a silence as argument),
the bytes of pings and pongs, encoding time, and whatever lies behind the server.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym.benchmark.run import draw
from bufgym.errors import BufgymError
from bufgym.model.topics import Topic
from bufgym.reproduce.report import COLOURS
from bufgym.scenario import Client, Stream
from bufgym.scenario.checks import above_0
from bufgym.sim import NEVER
from bufgym.sim import run as run_policy
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
"""Our choice. With n_T = 1 it bounds what crosses: one message per (transmission + round trip)."""
QUEUE_SIZE = 10
"""Of a native ROS publisher, messages; our choice, as in ROS's own tutorials."""
MBIT = 125_000
"""Bytes/s in a Mbit/s."""


Row = dict[str, Any]


@dataclass(frozen=True)
class Rival:
    """Who sends: a policy, and what its operator asks of the topics."""

    policy: str
    label: str
    colour: str
    marker: str
    all_no_drop: bool = False
    queued: bool = False
    """Whether each topic has a queue of its own, of ``queue_size`` messages."""


RIVALS = {
    "robofleet": Rival("robofleet", "Robofleet, n_T = 1", COLOURS["afr"], "o"),
    "no-drop": Rival("robofleet", "Robofleet, all no_drop", COLOURS["drop-oldest"], "s", all_no_drop=True),
    "no-drop-released": Rival("robofleet-released", "released, all no_drop", "#e69f00", "^", all_no_drop=True),
    "rosbridge": Rival("rosbridge", "rosbridge", COLOURS["random"], "D"),
    "ros-native": Rival("ros-native", "native ROS", "#cc79a7", "v", queued=True),
}


@dataclass(frozen=True)
class Sent:
    """What became of every message of one run, in order of arrival."""

    topic: NDArray[np.int64]
    consumer: NDArray[np.int64]
    """Whose copy it is, where the sender makes copies; else 0."""
    arrival_s: NDArray[np.float64]
    received_s: NDArray[np.float64]
    """At the server; NaN for a message that was dropped."""

    @property
    def latency_s(self) -> NDArray[np.float64]:
        """From arrival at the sender to the server; NaN for a message that was dropped."""
        return self.received_s - self.arrival_s

    @property
    def got(self) -> Sent:
        """Those that reached the server, in the order in which they did."""
        in_order = np.argsort(self.received_s, kind="stable")  # NaN comes last
        return self._only(in_order[: int((~np.isnan(self.received_s)).sum())])

    def on(self, topic: int) -> Sent:
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
    rules = Topic(kind, **topic)
    return Stream(rules, rate_hz, flatbuffer, jitter=jitter, encodings={"ros": ros, "json": json})


def cloud_bytes(points: int) -> tuple[int, int, int]:
    """Bytes of a PointCloud2 as ROS binary, Robofleet flatbuffer and JSON."""
    if isinstance(points, bool) or not isinstance(points, int) or not 1 <= points <= 10**7:
        raise BufgymError(f"points = {points!r}: must be a whole number from 1 to 10000000")
    ros, flatbuffer = (points * POINT_BYTES + extra for extra in _CLOUD_EXTRA)
    return ros, flatbuffer, round(points * _CLOUD_JSON)


def meet(
    name: str,
    streams: Sequence[Stream],
    link: Trace,
    duration_s: float,
    seed: int = 0,
    *,
    round_trip_ms: float = ROUND_TRIP_MS,
    queue_size: int = QUEUE_SIZE,
    consumers: int = 1,
) -> Sent:
    """What becomes of the streams' messages when one of ``RIVALS`` sends them; ``link`` begins with the first."""
    rival = RIVALS[name]
    rules: dict[str, Any] = {"no_drop": True} if rival.all_no_drop else {}
    if rival.queued:
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
    senders = run_policy(policies.get(rival.policy), [draw(client, seed)], room, client.value, topics=client.topics)
    sender = senders.batch.senders[0]
    arrivals = np.asarray(senders.batch.arrivals[0])[: sender["arrivals"]]
    transmitted_us = np.asarray(senders.batch.log[0])[: sender["arrivals"]]["transmitted_us"]
    received_s = np.where(transmitted_us == NEVER, np.nan, (transmitted_us + sender["propagation_us"]) / 1e6)
    consumer, topic = np.divmod(arrivals["topic"], len(streams))
    return Sent(topic, consumer, arrivals["arrival_us"] / 1e6, received_s)


# --- statistics ------------------------------------------------------------------------------------------------------


def mean_of(rows: Sequence[Row], column: str, **where: object) -> float:
    """Mean of a column over the rows in which the columns of ``where`` are so; NaN of nothing."""
    known = [row[column] for row in rows if all(row[name] == given for name, given in where.items())]
    return float(np.mean(known)) if known else math.nan


def p95(numbers: NDArray[np.float64]) -> float:
    return float(np.percentile(numbers, 95)) if len(numbers) else math.nan


def columns(rows: Sequence[Row]) -> tuple[list[str], list[list[object]]]:
    """(header, lines) of a report, with every digit."""
    header = list(rows[0])
    return header, [[repr(float(v)) if isinstance(v, float) else v for v in map(row.get, header)] for row in rows]


def style(name: str) -> dict[str, Any]:
    """How this sender's line is drawn."""
    rival = RIVALS[name]
    return {"color": rival.colour, "marker": rival.marker, "markersize": 4.5, "linewidth": 1.4}


# --- options ---------------------------------------------------------------------------------------------------------


def all_above_0(name: str, given: Sequence[float]) -> None:
    """An error unless these are numbers > 0, at least one."""
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise BufgymError(f"{name} = {given!r}: need at least one number")
    for number in given:
        above_0(name, number)


def at_least_0(name: str, number: float) -> None:
    if isinstance(number, bool) or not isinstance(number, int | float) or not 0 <= number < math.inf:
        raise BufgymError(f"{name} = {number!r}: must be a number >= 0")


def whole(name: str, number: int) -> None:
    if isinstance(number, bool) or not isinstance(number, int) or number < 1:
        raise BufgymError(f"{name} = {number!r}: must be a whole number >= 1")


def holds(claim: bool) -> str:
    return "holds here" if claim else "DOES NOT HOLD here"

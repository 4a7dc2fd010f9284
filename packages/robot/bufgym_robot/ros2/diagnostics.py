"""What ``/diagnostics`` tells of a relay's queue, once a second, for each topic."""

import importlib
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bufgym.model.qoi import Value
from bufgym_robot.wire.log import Record


@dataclass
class Numbers:
    """Counts of one topic since the start."""

    arrived: int = 0
    left: int = 0
    dropped: int = 0
    left_bytes: int = 0
    qoi: float = 0.0
    """H of what has left."""
    x: float = 0.0
    """Coordinate of the last message that has left."""


class Diagnostics:
    """Numbers of each topic. Call it with each record, as a queue calls its log."""

    def __init__(self, values: Sequence[Value], clock: Callable[[], float] = time.monotonic) -> None:
        """``values`` has V of each topic."""
        self._values, self._clock = values, clock
        self._numbers = [Numbers() for _ in values]
        self._returned = [Numbers() for _ in values]
        self._returned_s = clock()
        self._present: dict[int, tuple[float, Record]] = {}  # puts of messages queued or in the socket, by seq
        self._socket: set[int] = set()
        self._lock = threading.Lock()

    def __call__(self, record: Record) -> None:
        """Take one record."""
        event = record["event"]
        if event == "settings":
            return
        with self._lock:
            if event == "put":
                self._present[record["seq"]] = self._clock(), record
                self._numbers[record["topic"]].arrived += 1
            elif event == "dequeued":
                self._socket.add(record["seq"])
            else:
                self._socket.discard(record["seq"])
                self._count(event, self._present.pop(record["seq"])[1])

    def _count(self, event: str, put: Record) -> None:
        one = self._numbers[put["topic"]]
        if event == "dropped":
            one.dropped += 1
            return
        one.qoi += self._values[put["topic"]](put["x"] - one.x) if one.left else 1.0
        one.x = put["x"]
        one.left += 1
        one.left_bytes += put["size_bytes"]

    def tell(self) -> list[dict[str, float]]:
        """Each topic's numbers by name; rates are over the time since the last call."""
        with self._lock:
            now_s = self._clock()
            passed_s = max(1e-6, now_s - self._returned_s)
            waiting = [(at_s, put["topic"]) for seq, (at_s, put) in self._present.items() if seq not in self._socket]
            statuses = []
            for k, (now, before) in enumerate(zip(self._numbers, self._returned, strict=True)):
                ages = [now_s - at_s for at_s, topic in waiting if topic == k]
                statuses.append(
                    {
                        "arrived per s": (now.arrived - before.arrived) / passed_s,
                        "left per s": (now.left - before.left) / passed_s,
                        "left Mbit/s": (now.left_bytes - before.left_bytes) * 8e-6 / passed_s,
                        "arrived": now.arrived,
                        "left": now.left,
                        "dropped": now.dropped,
                        "queued": len(ages),
                        "oldest s": max(ages, default=0.0),
                        "QoI": now.qoi,
                    }
                )
                self._returned[k] = Numbers(**vars(now))
            self._returned_s = now_s
            return statuses


def publisher(node: Any, say: Callable[[str], None]) -> Callable[[Mapping[str, dict[str, float]], str], None]:
    """Make a function that publishes topics' numbers by name, and why there is no connection ("" if there is one)."""
    try:
        messages = importlib.import_module("diagnostic_msgs.msg")
    except ModuleNotFoundError:
        say("/diagnostics: left out: diagnostic_msgs is not installed here")
        return lambda numbers, fault: None
    published = node.create_publisher(messages.DiagnosticArray, "/diagnostics", 10)

    def publish(numbers: Mapping[str, dict[str, float]], fault: str) -> None:
        array = messages.DiagnosticArray()
        array.header.stamp = node.get_clock().now().to_msg()
        for name, values in {"uplink": {}, **numbers}.items():
            one = messages.DiagnosticStatus(name=f"{node.get_fully_qualified_name()}: {name}", hardware_id="bufgym")
            one.level = one.WARN if fault else one.OK
            one.message = fault or "connected"
            one.values = [messages.KeyValue(key=key, value=f"{number:g}") for key, number in values.items()]
            array.status.append(one)
        published.publish(array)

    return publish

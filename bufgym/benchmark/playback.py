"""A recording as policies would have sent it: an MCAP file that Foxglove and rerun show beside the recording itself.

Of a topic ``/camera`` and a policy ``afr`` the file has ``/afr/delivered/camera``, each message when it is received,
and ``/afr/dropped/camera``, each when it is dropped. ``/afr/queue`` is JSON with the queue's length. Messages still
under way when the stream ends are in neither.
"""

import heapq
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from bufgym.benchmark.tasks import QueueTask
from bufgym.policies import Policy
from bufgym.scenario import Uplink
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim.state import NEVER
from bufgym.traces import read_bag
from bufgym.traces.formats.bags import messages
from bufgym.traces.formats.definitions import BagTopic, typestore
from bufgym.traces.formats.splits import is_recording
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import replaced
from bufgym.utils.libraries import needs

_QUEUE: Final = {
    "title": "queue",
    "type": "object",
    "properties": {"length": {"type": "integer"}, "bytes": {"type": "integer"}},
}

Int64Array = npt.NDArray[np.int64]
_Event = tuple[int, int, int, bytes]
"""Time in us, a number that orders equal times, channel and content."""


def write_playback(
    path: Path,
    recording: str | Sequence[str],
    policies: Sequence[Policy],
    scenario: Uplink,
    capacity: int,
    seed: int = 0,
    advance: Callable[[int], object] = int,
    **settings: Any,
) -> dict[str, tuple[int, int]]:
    """Write the file; return how many messages of the recording each policy delivered, and dropped.

    Args:
        path: the file to write.
        recording: the recording that the scenario plays, of one file or several; its messages are copied.
        policies: those that play, on the first of the scenario's traces.
        scenario: it plays the recording (``workload``).
        capacity: L.
        seed: of the episode.
        advance: called with 1 for each message, as a progress bar's update.
        settings: further arguments of the task, as of ``drops``.
    """
    workload = scenario.workload
    files = [recording] if isinstance(recording, str) else recording
    if workload is None or not all(map(is_recording, files)):
        raise BufgymError(f"{recording}: must be a recording that holds the messages themselves (MCAP, ROS bag)")
    _, part = by_trace(scenario)[0]
    episode, task = draw(part, seed), QueueTask(**settings)
    logs = {}
    for policy in policies:
        senders = task.meet(policy, [episode], capacity, part)
        logs[policy.name] = np.asarray(senders.batch.log[0])[: len(episode.arrivals)]
    with needs("mcap", "ros", "--mcap"), replaced(path) as target, target.open("wb") as file:
        return _write(file, files, workload.topics, np.asarray(episode.arrivals), logs, scenario, advance)


def _write(
    file: Any,
    recording: str | Sequence[str],
    topics: Sequence[str],
    arrivals: npt.NDArray[Any],
    logs: dict[str, npt.NDArray[Any]],
    scenario: Uplink,
    advance: Callable[[int], object],
) -> dict[str, tuple[int, int]]:
    from mcap.writer import Writer

    bag = read_bag(recording)
    is_played = np.isin(bag.topic, [k for k, name in enumerate(bag.topics) if name in topics])
    from_ns = int(bag.time_ns[is_played][0])
    writer = Writer(file)
    writer.start(profile="ros1" if bag.kind == "ros1" else "ros2", library="bufgym playback")
    channels: dict[tuple[str, BagTopic], int] = {}
    counts = {
        name: (int((log["transmitted_us"] != NEVER).sum()), int((log["dropped_us"] != NEVER).sum()))
        for name, log in logs.items()
    }
    queues = []
    for name, log in logs.items():
        schema = writer.register_schema("queue", "jsonschema", json.dumps(_QUEUE).encode())
        queue = writer.register_channel(f"/{name}/queue", "json", schema)
        queues.append(_lengths(queue, queue_lengths(arrivals, log)))

    def played() -> Iterator[_Event]:
        """What becomes of the messages, in order of time: nothing happens to one before it arrives."""
        under_way: list[_Event] = []
        own = (message for message in messages(bag) if message[0].topic in topics)
        for k, (channel, _, data) in enumerate(itertools.islice(own, len(arrivals))):
            for name, log in logs.items():
                received_us, dropped_us = int(log["transmitted_us"][k]), int(log["dropped_us"][k])
                if received_us == dropped_us == NEVER:
                    continue
                what, us = ("dropped", dropped_us) if dropped_us != NEVER else ("delivered", received_us)
                topic = f"/{name}/{what}/{channel.topic.lstrip('/')}"
                if (topic, channel) not in channels:
                    channels[topic, channel] = _channel(writer, topic, channel)
                delay_us = scenario.propagation_us if what == "delivered" else 0
                heapq.heappush(under_way, (us + delay_us, k, channels[topic, channel], data))
            while under_way and under_way[0][0] <= arrivals["arrival_us"][k]:
                yield heapq.heappop(under_way)
            advance(1)
        yield from sorted(under_way)

    for us, _, number, data in heapq.merge(played(), *queues):
        writer.add_message(number, from_ns + us * 1000, data, from_ns + us * 1000)
    writer.finish()  # type: ignore[no-untyped-call]
    return counts


def _lengths(channel: int, rows: Int64Array) -> Iterator[_Event]:
    for k, (us, length, count) in enumerate(rows):
        yield int(us), k, channel, json.dumps({"length": int(length), "bytes": int(count)}).encode()


def queue_lengths(arrivals: npt.NDArray[Any], log: npt.NDArray[Any]) -> Int64Array:
    """Rows of time in us, messages and bytes in the queue from then on, int64[n, 3]; one row for each time."""
    left_us = np.maximum(log["dequeued_us"], log["dropped_us"])  # the other is NEVER, -1
    has_left, size = left_us != NEVER, arrivals["size_bytes"]
    times_us = np.concatenate([arrivals["arrival_us"], left_us[has_left]]).astype(np.int64)
    steps = np.concatenate([np.ones(len(arrivals), np.int64), np.full(int(has_left.sum()), -1, np.int64)])
    order = np.argsort(times_us, kind="stable")
    times_us, steps = times_us[order], steps[order]
    count = np.cumsum(steps)
    held = np.cumsum(steps * np.concatenate([size, size[has_left]])[order])
    is_last = np.append(times_us[1:] != times_us[:-1], True)
    return np.asarray(np.stack([times_us, count, held], axis=1)[is_last], np.int64)


def _channel(writer: Any, topic: str, channel: BagTopic) -> int:
    """Declare a topic with the type that the recording has, defined as in ROS where it does not say."""
    definition, language, name = channel.definition, channel.language, channel.type
    is_ros1 = channel.encoding == "ros1"
    if not definition and channel.encoding in ("cdr", "ros1") and name in typestore(channel.encoding).fielddefs:
        definition, _ = typestore(channel.encoding).generate_msgdef(name, ros_version=1 if is_ros1 else 2)
        language = "ros1msg" if is_ros1 else "ros2msg"
    name = name.replace("/msg/", "/") if is_ros1 else name
    schema = writer.register_schema(name, language, definition.encode())
    number: int = writer.register_channel(topic, channel.encoding, schema)
    return number

"""Drop rules of robots' middleware today: ROS, DDS, Zenoh, Foxglove and rosbridge, with their own names for settings.

Most keep the newest messages or reject the newcomer, as `drop-oldest` and `drop-newest` do. They have their own names
here so that their users find them in a table. None knows the worth of a message.
"""

from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.policies.classic import drop_newest, drop_oldest, keep_first, keep_last
from bufgym.policies.registry import Arrival, ClientSettings, Memory, built_in


@built_in("ros-keep-last", parameters={"depth": 10.0}, source="ROS 2 QoS history KEEP_LAST(depth), default 10")
def ros_keep_last(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """ROS 2 KEEP_LAST: the oldest unsent message goes when `depth` wait (at most L)."""
    return keep_last(buffer, arrival, buffer.parameters[0])


built_in(
    "dds-keep-all",
    source="DDS QoS HISTORY KEEP_ALL with best-effort RELIABILITY",
    about="DDS KEEP_ALL, best effort: a full queue rejects the newcomer; reliable would block the publisher instead.",
)(drop_newest)


def expired(buffer: Buffer, memory: Memory) -> bool:
    """Whether the head has outlived its lifespan; later messages are younger."""
    return bool(buffer.now_us - buffer.slots[0].arrival_us > 1e6 * buffer.parameters[0])


@built_in("lifespan", parameters={"lifespan_s": 0.5}, on_dequeue=expired, source="DDS QoS LIFESPAN")
def lifespan(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """DDS LIFESPAN: nothing older than `lifespan_s` is sent; drop-oldest when full.

    DDS removes a message when it expires. Here it goes when it would be sent; until then it would be next to go anyway.
    """
    return keep_last(buffer, arrival, buffer.capacity)


@built_in("time-filter", parameters={"separation_s": 0.1}, source="DDS QoS TIME_BASED_FILTER, minimum_separation")
def time_filter(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """DDS TIME_BASED_FILTER: accepts at most one message in `separation_s`; drop-oldest when full."""
    s, separation_us = len(buffer.slots), 1e6 * buffer.parameters[0]
    # The tail is the message accepted last, as it is never dropped before the head.
    last_us = buffer.slots[s - 1].arrival_us if s > 0 else buffer.dequeued_arrival_us
    if s + buffer.dequeued > 0 and arrival.arrival_us - last_us < separation_us:
        return REJECT
    return keep_last(buffer, arrival, buffer.capacity)


built_in("zenoh-ring", source="Zenoh RingChannel(L)", about="Zenoh RingChannel: keeps the newest L.")(drop_oldest)
built_in(
    "foxglove-sdk",
    parameters={"depth": 1024.0},
    source="foxglove-sdk, message backlog of a client, default 1024",
    about="Foxglove SDK: a client's oldest message is dropped when `depth` wait (at most L).",
)(ros_keep_last)


@built_in(
    "foxglove-backlog",
    parameters={"limit_mb": 10.0},
    source="ros-foxglove-bridge, send_buffer_limit, default 10 MB",
    reads_left=True,
)
def foxglove_backlog(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """ros-foxglove-bridge: drops the newcomer when all bytes not yet sent, with it, reach `limit_mb`, or none fits."""
    buffered_bytes = buffer.backlog_bytes + buffer.left_bytes
    if buffered_bytes + arrival.size_bytes >= 1e6 * buffer.parameters[0]:
        return REJECT
    return keep_first(buffer, arrival)


@built_in(
    "rosbridge",
    unbounded=True,
    source="rosbridge_server, unbounded outgoing queue",
    client=ClientSettings(encoding="json", awaits_acks=False),
)
def rosbridge(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """rosbridge: accepts everything, however long the queue grows; JSON, first in, first out, without acks."""
    return ACCEPT

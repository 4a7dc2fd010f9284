"""Latched state: what is owed to a receiver, what goes first, and what the writer at the other end holds."""

import asyncio
from dataclasses import replace
from unittest.mock import AsyncMock

from live_cases import Channel, receiving
from loop_cases import beside, until

from bufgym_robot import PolicyQueue
from bufgym_robot.channels import TcpChannel
from bufgym_robot.frames import LATCHED, Frame
from bufgym_robot.latched import Latched
from bufgym_robot.receiver import Received
from bufgym_robot.ros2.names import Published
from bufgym_robot.ros2.states import States
from bufgym_robot.sender import Sender

TF = Published("/tf_static", "tf2_msgs/msg/TFMessage", transient_local=True, depth=3)


def owed(latched: Latched) -> list[tuple[int, bytes]]:
    """Publishers and messages that are owed, in the order in which they go."""
    found, number = [], -1
    while (state := latched.owed(number)) is not None:
        number = state.number
        found.append((state.source, state.message))
    return found


def test_the_last_message_of_each_publisher_is_owed_until_its_ack() -> None:
    """Numbers: a1 0, b1 1, a2 2. The ack of 0 comes late and is nobody's."""
    latched = Latched()
    for source, message in ((7, b"a1"), (8, b"b1"), (7, b"a2"), (8, b"b1")):
        latched.put(0, source, message, 5)
    assert latched.count(0) == (2, 2)
    assert owed(latched) == [(8, b"b1"), (7, b"a2")]
    latched.ack(0)
    latched.ack(1)
    assert owed(latched) == [(7, b"a2")]
    latched.put(0, 8, b"b1", 5)  # the same publication, of a new subscription
    assert owed(latched) == [(7, b"a2")] and latched.count(0) == (2, 1)
    latched.owe_all()
    assert owed(latched) == [(8, b"b1"), (7, b"a2")]
    for number in (1, 2):
        latched.ack(number)
    latched.put(0, 8, b"b1", 6)  # said once more
    assert owed(latched) == [(8, b"b1")]


def test_publishers_that_are_gone_are_forgotten_and_the_others_told_again() -> None:
    """Another topic's publisher of the same number stays as it is."""
    latched = Latched()
    for topic, source in ((0, 7), (0, 8), (1, 8)):
        latched.put(topic, source, b"state", 5)
    for number in range(3):
        latched.ack(number)
    latched.keep(0, {7, 8})
    assert owed(latched) == []
    latched.keep(0, {7})
    assert owed(latched) == [(7, b"state")] and latched.sources(0) == [7] and latched.sources(1) == [8]


async def test_states_go_first_at_each_connection_and_all_of_them_to_another_receiver() -> None:
    """1,000 messages drop all but 4 of the queue and none of 40 states; a restart brings the 40 again."""
    latched, queue = Latched(), PolicyQueue("drop-oldest", 4)
    for source in range(40):
        latched.put(0, source, b"state", 5)
    for _ in range(1000):
        queue.put(b"frame", 5)

    def sources(came: list[Received]) -> list[int | None]:
        return [message.source for message in came]

    async with receiving() as (first, port, came):
        sender = Sender(queue, lambda: TcpChannel.connect("127.0.0.1", port), "acked", latched=latched)
        async with beside(sender.run()):
            await until(lambda: len(came) == 45)  # one message had been in the socket
            assert sources(came) == [*range(40), *[None] * 5] and {one.at_us for one in came[:40]} == {5}
            latched.put(0, 7, b"newer", 6)
            await until(lambda: len(came) == 46)
            assert came[-1].source == 7 and came[-1].body == b"newer"
            await until(lambda: latched.owed() is None)
            await first.close()
            queue.put(b"frame", 5)
            latched.put(0, 8, b"newer", 7)
            async with receiving(port) as (_, _, again):
                await until(lambda: len(again) == 41)
                assert sources(again) == [*(one for one in range(40) if one not in (7, 8)), 7, 8, None]
                queue.close()
                await until(lambda: sender.queue.in_flight == 0)


async def test_a_connection_that_breaks_brings_only_what_is_owed() -> None:
    """The receiver is the same, so of two states the acked one does not come again."""
    latched, queue = Latched(), PolicyQueue("drop-oldest", 4)
    channels: list[TcpChannel] = []
    async with receiving() as (_, port, came):

        async def connect() -> TcpChannel:
            channels.append(await TcpChannel.connect("127.0.0.1", port))
            return channels[-1]

        async with beside(Sender(queue, connect, latched=latched).run()):
            latched.put(0, 1, b"map", 5)
            await until(lambda: came and latched.owed() is None)
            channels[0]._socket.shutdown(2)
            latched.put(0, 2, b"description", 6)
            await until(lambda: len(channels) == 2 and latched.owed() is None)
            await asyncio.sleep(0)
    assert [one.source for one in came if one.source == 1] == [1] and 2 in [one.source for one in came]


class Busy(Channel):
    """A channel that sends a state only when its publisher has a newer one."""

    def __init__(self, latched: Latched) -> None:
        super().__init__(hidden=True)
        self._latched = latched

    async def send(self, frame: Frame) -> None:
        await super().send(frame)
        await asyncio.sleep(0)
        if frame.kind == LATCHED:
            self._latched.put(0, 1, b"state", frame.at_us + 1)


async def test_states_without_end_do_not_hold_the_queue_up() -> None:
    """The queue's message goes after those that were owed at first."""
    latched, queue = Latched(), PolicyQueue("drop-oldest", 4)
    latched.put(0, 1, b"state", 0)
    queue.put(b"frame", 5)
    channel = Busy(latched)
    async with beside(Sender(queue, AsyncMock(return_value=channel), latched=latched).run()):
        await until(lambda: channel.sent == [0])


class History:
    """The history of a writer, of which a late reader gets the last ``depth``."""

    def __init__(self, topic: Published) -> None:
        self.depth, self.published = topic.depth, list[bytes]()

    def publish(self, message: bytes) -> None:
        self.published.append(message)

    @property
    def late(self) -> list[bytes]:
        return self.published[-self.depth :]


def test_a_late_reader_gets_the_last_of_each_publisher() -> None:
    """Three drivers: the second one's news would push the first one's only message out."""
    gone: list[History] = []
    states = States(History, gone.append)
    for source, message in ((1, b"a"), (2, b"b"), (3, b"c")):
        states.take(TF, "robot", source, message)
    assert states.writer.published == [b"a", b"b", b"c"]
    states.take(TF, "robot", 2, b"b2")
    assert states.writer.published[3:] == [b"a", b"b2"] and sorted(states.writer.late) == [b"a", b"b2", b"c"]
    states.take(TF, "robot", 3, b"c2")  # the oldest one
    assert states.writer.published[5:] == [b"c2"] and states.writer.late == [b"a", b"b2", b"c2"]
    assert states.writer.depth == 3 and gone == []


def test_a_map_whose_server_starts_again_is_the_new_one() -> None:
    """One publisher, so the dead one's map goes; a robot that starts again is another sender, and its map is last."""
    states, topic = States(History, lambda writer: None), replace(TF, depth=1)
    states.take(topic, "robot", 1, b"map")
    states.take(topic, "robot", 2, b"new map")
    assert states.writer.late == [b"new map"] and states.writer.depth == 1
    states.take(topic, "the robot again", 3, b"newest map")
    assert states.writer.late == [b"new map", b"newest map"]
    for k in range(100):
        states.take(topic, f"start {k}", 4 + k, b"map %d" % k)
    assert states.writer.late == [b"map %d" % k for k in range(84, 100)]


def test_a_writer_is_made_again_when_the_publishers_become_more() -> None:
    """From two to three; the new writer has all that the old one had."""
    gone: list[History] = []
    states = States(History, gone.append)
    states.take(replace(TF, depth=2), "robot", 1, b"a")
    states.take(replace(TF, depth=2), "robot", 2, b"b")
    states.take(TF, "robot", 3, b"c")
    assert [one.depth for one in gone] == [2] and states.writer.depth == 3
    assert states.writer.late == [b"a", b"b", b"c"]

"""What goes wrong on a robot: no deadlock, no duplicate, order kept, memory bounded; it connects again by itself."""

import asyncio
import contextlib
import os
import socket
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import pytest
from live_cases import Channel, in_order, meeting_port, put, receiving, sending
from loop_cases import beside, until
from refusal_cases import refuse

from bufgym.model.link import Link
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym_robot import LogFile, PolicyQueue, read_log, replay
from bufgym_robot import buses as libraries
from bufgym_robot.bus_channel import BusChannel, BusServer
from bufgym_robot.buses import BUSES
from bufgym_robot.channels import TRANSPORTS, TcpChannel
from bufgym_robot.commands import Transport
from bufgym_robot.frames import ACK, DATA, GOODBYE, GREETING, HEADER_BYTES, Frame, FrameError, Room, header, parse
from bufgym_robot.receiver import Received, Recording, listener
from bufgym_robot.sender import Sender
from bufgym_robot.shaped import ShapedLink
from bufgym_robot.wire.tasks import Tasks

CUT_S = float(os.environ.get("BUFGYM_CUT_S", "5"))
"""The long cut; by hand also BUFGYM_CUT_S=60."""


def test_the_command_knows_every_transport() -> None:
    assert tuple(TRANSPORTS) == get_args(get_args(Transport)[0])


@pytest.mark.parametrize(
    ("transport", "cut_s"),
    [*((transport, 0.0) for transport in TRANSPORTS), pytest.param("tcp", CUT_S, marks=pytest.mark.nightly)],
)
async def test_a_link_cut_and_back(transport: str, cut_s: float, request: pytest.FixtureRequest) -> None:
    """While the link is cut the policy drops, and memory holds no more than before."""
    meeting, records = meeting_port(transport, request), list[Any]()
    async with receiving(meeting, transport) as (_, port, came):
        link = ShapedLink(Link(Trace.constant(2e7, duration_s=1)), ("127.0.0.1", port))
        port = await link.listen()
        async with sending(port, transport, log=records.append) as (queue, sender):
            put(queue, 5)
            await until(lambda: len(came) == 5)
            link.cut()
            put(queue, 40)
            await until(lambda: sender.faults)
            for _ in range(round(200 * cut_s)):  # 200 messages a second
                put(queue, 1)
                await asyncio.sleep(0.005)
            assert len(came) == 5
            link.mend()
            await until(lambda: len(queue) + queue.in_flight == 0)
            put(queue, 5)
        await link.close()
        most = 50 + round(200 * cut_s)
        assert in_order(came) and came[-1].seq == most - 1
        assert len(came) + queue.dropped == most and queue.dropped >= most - 15
        assert replay(records).differences == ()


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_a_slow_receiver_slows_the_sender_not_the_robot(transport: str, request: pytest.FixtureRequest) -> None:
    """60 messages while the receiver takes the first: without a window of one ack a library would hold most of them.

    With it the queue does: the last four of them are there when the receiver goes on.
    """
    meeting, free = meeting_port(transport, request), asyncio.Event()

    async def slowly(message: Received) -> None:
        await free.wait()

    async with receiving(meeting, transport, slowly) as (receiver, port, came):
        async with sending(port, transport) as (queue, sender):
            put(queue, 1)
            await until(lambda: came)
            for _ in range(59):
                put(queue, 1)
                await asyncio.sleep(0)
            assert (len(queue), queue.in_flight, queue.dropped) == (4, 1, 55)
            free.set()
        assert in_order(came) and [message.seq for message in came] == [0, 56, 57, 58, 59]
        assert all(bytes(message.body) == bytes(50_000) for message in came)
        assert not sender.faults and not receiver.faults


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_a_receiver_that_goes_and_comes_back(transport: str, request: pytest.FixtureRequest) -> None:
    """The sender, idle, sees it go, and is there for the next one: which knows of no message 0, and expects none."""
    meeting = meeting_port(transport, request)
    async with contextlib.AsyncExitStack() as stack:
        _, port, first = await stack.enter_async_context(receiving(meeting, transport))
        async with sending(port, transport) as (queue, sender):
            put(queue, 1)
            await until(lambda: first)
            await stack.aclose()
            await until(lambda: sender.faults)
            put(queue, 1)
            _, _, second = await stack.enter_async_context(receiving(port, transport))
    assert [message.number for message in first] == [0] and second[-1].number == 1


@pytest.mark.parametrize("leaves", ["acked", "sent"])
async def test_a_receiver_killed_and_restarted(leaves: str) -> None:
    """What the first got and could not ack any more may come to the second as well: it knows nothing of it."""
    async with contextlib.AsyncExitStack() as stack:
        _, port, came = await stack.enter_async_context(receiving())
        async with sending(port, leaves=leaves) as (queue, sender):
            for _ in range(10):
                put(queue, 2)
                await asyncio.sleep(0)
            await until(lambda: came)
            await stack.aclose()  # in the middle of a message
            await until(lambda: sender.faults)
            put(queue, 20)
            _, _, again = await stack.enter_async_context(receiving(port))
    numbers = [message.number for message in again]
    assert in_order(came) and numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert numbers[0] in (len(came), len(came) - 1) and again[-1].seq == 39
    assert queue.in_flight == 0 and len(queue) == 0


@pytest.mark.parametrize(
    "junk",
    [
        b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n" + bytes(100),
        bytes(1000),
        header(Frame(DATA, 0)),
        header(Frame(GREETING, 0, body=bytes(17))),
        header(Frame(GREETING, 0, body=bytes(16))) + bytes(16) + header(Frame(DATA, 0, body=bytes(1001))),
        header(Frame(GREETING, 0, body=bytes(16))) + bytes(16) + header(Frame(DATA, 5)),
    ],
    ids=["http", "zeros", "no greeting", "long name", "oversize", "gap"],
)
async def test_a_peer_that_sends_garbage_is_hung_up_on(junk: bytes) -> None:
    async with receiving(max_body_bytes=1000) as (receiver, port, came):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(junk)
        with contextlib.suppress(ConnectionResetError):
            while await reader.read(1000):
                pass  # an answer to a greeting, then the end
        writer.close()
        assert len(receiver.faults) == 1 and receiver.faults[0].startswith("FrameError")
        # Others are served as before.
        async with sending(port) as (queue, _):
            queue.put(b"well", 4)
        assert [bytes(message.body) for message in came] == [b"well"]


@pytest.mark.parametrize("transport", BUSES)
async def test_who_does_not_greet_is_hung_up_on(transport: str, request: pytest.FixtureRequest) -> None:
    async with receiving(meeting_port(transport, request), transport) as (receiver, port, _):
        channel = await BusChannel.connect(BUSES[transport], "127.0.0.1", port)
        await channel.send(Frame(DATA, 0))
        with pytest.raises(ConnectionResetError):
            await channel.receive()
        channel.close()
        await until(lambda: receiver.faults)
        assert "must be a greeting first" in receiver.faults[0]


async def test_who_greets_before_the_receiver_has_its_bus_is_served() -> None:
    """A library's thread hears it while the receiver is still being told that it listens."""
    loop, came, tasks = asyncio.get_running_loop(), asyncio.Queue[Frame](), Tasks()

    def opening(host: str, port: int, name: str, hear: Any, peer: Any) -> Any:
        hear("sender", header(Frame(GREETING, 0, body=bytes(16))) + bytes(16))
        asyncio.run_coroutine_threadsafe(asyncio.sleep(0), loop).result()
        return SimpleNamespace(publish=None, close=None)

    async def serve(channel: BusChannel) -> None:
        came.put_nowait(await channel.receive())

    await BusServer(serve, tasks.begin, 1000, Room(1000)).listen(opening, "", 0)
    assert (await came.get()).kind == GREETING
    await tasks.end()


async def test_a_receiver_that_sends_garbage_is_left() -> None:
    async def babble(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"\xff" * 100)
        await reader.read()  # until the sender has left: to a socket that is closed it could not even greet
        writer.close()

    server = await asyncio.start_server(babble, "127.0.0.1")
    port = server.sockets[0].getsockname()[1]
    async with contextlib.AsyncExitStack() as stack, sending(port) as (queue, sender):
        put(queue, 5)
        await until(lambda: any("FrameError" in fault for fault in sender.faults))
        server.close()
        await server.wait_closed()
        _, _, came = await stack.enter_async_context(receiving(port))
    assert in_order(came) and came[-1].seq == 4


async def test_a_message_larger_than_the_receiver_takes_is_an_error() -> None:
    async with receiving(max_body_bytes=10) as (_, port, _):
        queue = PolicyQueue("afr", 4)
        queue.put(bytes(11), 11)
        with pytest.raises(BufgymError, match="message 0 of 11 bytes: the receiver takes at most 10"):
            await Sender(queue, lambda: TcpChannel.connect("127.0.0.1", port)).run()


@pytest.mark.parametrize("transport", ["zenoh", "mqtt"])
async def test_nobody_there_is_tried_again(
    transport: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    meeting_port(transport, request)
    monkeypatch.setattr(libraries, "CONNECT_S", 0.05)
    sender = Sender(PolicyQueue("afr", 4), lambda: TRANSPORTS[transport]("127.0.0.1", 1))
    async with beside(sender.run()):
        await until(lambda: len(sender.faults) >= 2)


async def test_a_receiver_that_hangs_up_before_the_goodbye_is_known_as_sent_is_no_fault() -> None:
    """As over a bus, whose ``publish`` returns late: everything is acked, so nothing is begun again."""

    class Hasty(Channel):
        """Acks at once; hangs up on a goodbye whose sending has not returned."""

        async def send(self, frame: Frame) -> None:
            await super().send(frame)
            if frame.kind == DATA:
                self.answers.put_nowait(Frame(ACK, frame.number))
            elif frame.kind == GOODBYE:
                self.answers.put_nowait(frame)
                await asyncio.Event().wait()

        async def receive(self) -> Frame:
            answer = await super().receive()
            if answer.kind == GOODBYE:
                raise ConnectionResetError("the peer has gone")
            return answer

    connections: list[Hasty] = []

    async def connect() -> Any:
        connections.append(Hasty(hidden=True))
        return connections[-1]

    queue = PolicyQueue("drop-oldest", 4)
    sender = Sender(queue, connect)
    queue.put(b"last words", 10)
    queue.close()
    await sender.run()
    assert len(connections) == 1 and not sender.faults


def test_a_log_of_a_killed_sender_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    log = LogFile(path)
    queue = PolicyQueue("afr", 3, log=log, clock=lambda: 0.0)
    for k in range(200):
        queue.put("frame", 1000, at_us=20_000 * (k + 1))
        if k % 4 == 0:
            queue.get(timeout_s=0)
        if k % 4 == 3:
            queue.gone()
    killed = tmp_path / "killed.mcap"
    killed.write_bytes(path.read_bytes()[:-7])  # in the middle of a record
    whole = read_log(killed)
    assert len(whole) > 300
    assert all(replay(whole[:k]).differences == () for k in range(2, 30))  # wherever it breaks off
    assert replay(killed).differences == ()
    log.close()
    assert replay(path).differences == ()
    (tmp_path / "empty.mcap").write_bytes(b"")
    for name in ("empty", "none"):
        refuse(rf"{name}\.mcap", read_log, tmp_path / f"{name}.mcap")


def test_what_comes_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also from a clock far beyond any; a topic beyond the file's two channels is left out."""
    from mcap.reader import make_reader

    monkeypatch.setattr("bufgym_robot.wire.mcap_file.MAX_CHANNELS", 2)
    with Recording(tmp_path / "came.mcap") as recording:
        for topic, at_us in ((2, 2**64 - 1), (3, 5_000), (2, 5_000)):
            recording(Received("ab", 0, 7, at_us, 1.5, topic, b"frame", 10**9))
    assert recording.left_out == 1
    with (tmp_path / "came.mcap").open("rb") as file:
        found = {channel.topic: message for _, channel, message in make_reader(file).iter_messages()}
    assert found["/topic_2"].data == b"frame" and found["/topic_2"].sequence == 7
    assert b'"x": 1.5' in found["/received"].data and b'"size_bytes": 5' in found["/received"].data


async def test_a_task_that_is_cancelled_takes_no_message_with_it() -> None:
    queue = PolicyQueue("afr", 4)
    for _ in range(20):
        task = asyncio.create_task(queue.aget())
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
    waiting = asyncio.create_task(queue.aget())
    await asyncio.sleep(0)
    queue.put("frame", 10)
    item = await waiting
    assert item is not None and item.seq == 0


def test_threads_put_and_take_at_once() -> None:
    queue = PolicyQueue("drop-newest", 50, clock=lambda: 0.0)
    came: list[int] = []
    taker = threading.Thread(target=lambda: came.extend(item.seq for item in queue))
    makers = [threading.Thread(target=lambda: [queue.put("frame", 1) for _ in range(500)]) for _ in range(3)]
    for thread in (taker, *makers):
        thread.start()
    for maker in makers:
        maker.join()
    queue.close()
    taker.join()
    assert len(came) + queue.dropped == 1500 and came == sorted(set(came))


async def test_a_port_that_is_taken_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(BufgymError, match=f"127.0.0.1:{port}"):
            await listener("127.0.0.1", port)


def test_headers_by_hand() -> None:
    frame = Frame(DATA, 3, 5, 7_000, 2.5, 1, b"abc")
    data = header(frame)
    assert len(data) == HEADER_BYTES
    assert parse(data, 10) == (frame._replace(body=b""), 3)
    refuse("at most 2", parse, data, 2, kind=FrameError)
    refuse("at least", parse, data[:-1], 10, kind=FrameError)

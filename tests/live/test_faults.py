"""What goes wrong on a robot: no deadlock, no duplicate, order kept, memory bounded; it connects again by itself."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import threading
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_cases import OVER_TCP, meeting_port, slowly

from bufgym.errors import BufgymError
from bufgym.live import LogFile, PolicyQueue, read_log, replay
from bufgym.live import sender as sending
from bufgym.live.channels import TRANSPORTS, TcpChannel
from bufgym.live.frames import ACK, DATA, GOODBYE, GREETING, HEADER_BYTES, Frame, FrameError, header, parse
from bufgym.live.receiver import Received, Receiver, Recording, listener
from bufgym.live.sender import Sender
from bufgym.live.shaped import ShapedLink
from bufgym.model.link import Link
from bufgym.traces import Trace

FAST = Link(Trace("fast", np.array([0, 1_000_000]), np.array([0, 20_000_000])))
BODY = bytes(100_000)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sending, "RETRY_S", 0.05)


def within(work: Coroutine[Any, Any, None], limit_s: float = 30) -> None:
    """Run it; a deadlock is an error."""
    asyncio.run(asyncio.wait_for(work, limit_s))


async def puts(queue: PolicyQueue, n: int, body: bytes = BODY) -> None:
    """A message every 5 ms."""
    for _ in range(n):
        queue.put(body, len(body))
        assert len(queue) <= 4
        await asyncio.sleep(0.005)


def in_order(came: list[Received]) -> bool:
    """Whether each came once, in order."""
    return [message.number for message in came] == list(range(len(came)))


CUT_S = float(os.environ.get("BUFGYM_CUT_S", "5"))
"""The long cut; by hand also BUFGYM_CUT_S=60."""


@pytest.mark.parametrize(
    ("transport", "cut_s"), [*((transport, 0.2) for transport in OVER_TCP), pytest.param("tcp", CUT_S, id="tcp-long")]
)
def test_a_link_cut_and_back(transport: str, cut_s: float, request: pytest.FixtureRequest) -> None:
    """200 messages a second. While the link is cut the policy drops, and memory holds no more than before."""
    meeting, cut = meeting_port(transport, request), round(200 * cut_s)

    async def story() -> None:
        came: list[Received] = []
        receiver = Receiver(came.append)
        link = ShapedLink(FAST, ("127.0.0.1", await receiver.listen(meeting, transport=transport)))
        port = await link.listen()
        records: list[Any] = []
        queue = PolicyQueue("drop-oldest", 4, log=records.append)
        sender = Sender(queue, lambda: TRANSPORTS[transport]("127.0.0.1", port))
        task = asyncio.create_task(sender.run())
        await puts(queue, 20)
        link.cut()
        await puts(queue, cut)
        before = len(came)
        link.mend()
        await puts(queue, 20)
        queue.close()
        await task
        await link.close()
        await receiver.close()
        assert in_order(came) and len(came) > before and came[-1].seq == cut + 39
        assert len(came) + queue.dropped == cut + 40 and queue.dropped >= cut - 10
        assert sender.faults
        assert replay(records).differences == ()

    within(story(), 30 + 2 * cut_s)


@pytest.mark.parametrize("leaves", ["acked", "sent"])
def test_a_receiver_killed_and_restarted(leaves: Any) -> None:
    async def story() -> None:
        came: list[Received] = []
        again: list[Received] = []
        receiver = Receiver(came.append)
        port = await receiver.listen()
        queue = PolicyQueue("drop-oldest", 4)
        task = asyncio.create_task(Sender(queue, lambda: TcpChannel.connect("127.0.0.1", port), leaves).run())
        await puts(queue, 20)
        await receiver.close()
        await puts(queue, 20)
        receiver = Receiver(again.append)
        await receiver.listen(port)
        await puts(queue, 20)
        queue.close()
        await task
        await receiver.close()
        # What the first had got and could not ack any more may come to the second as well: it knows nothing of it.
        numbers = [message.number for message in again]
        assert in_order(came) and numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert numbers[0] in (len(came), len(came) - 1) and again[-1].seq == 59
        assert queue.in_flight == 0 and len(queue) == 0

    within(story())


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
def test_a_peer_that_sends_garbage_is_hung_up_on(junk: bytes) -> None:
    async def story() -> None:
        came: list[Received] = []
        receiver = Receiver(came.append, max_body_bytes=1000)
        port = await receiver.listen()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(junk)
        with contextlib.suppress(ConnectionResetError):
            while await reader.read(1000):
                pass  # an answer to a greeting, then the end
        writer.close()
        assert len(receiver.faults) == 1 and receiver.faults[0].startswith("FrameError")
        # Others are served as before.
        queue = PolicyQueue("afr", 4)
        queue.put(b"well", 4)
        queue.close()
        await Sender(queue, lambda: TcpChannel.connect("127.0.0.1", port)).run()
        await receiver.close()
        assert [bytes(message.body) for message in came] == [b"well"]

    within(story())


def test_a_receiver_that_sends_garbage_is_left() -> None:
    async def story() -> None:
        async def babble(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b"\xff" * 100)
            writer.close()

        server = await asyncio.start_server(babble, "127.0.0.1")
        port = server.sockets[0].getsockname()[1]
        queue = PolicyQueue("drop-oldest", 4)
        sender = Sender(queue, lambda: TcpChannel.connect("127.0.0.1", port))
        task = asyncio.create_task(sender.run())
        await puts(queue, 20)
        server.close()
        await server.wait_closed()
        came: list[Received] = []
        receiver = Receiver(came.append)
        await receiver.listen(port)
        queue.close()
        await task
        await receiver.close()
        assert any("FrameError" in fault for fault in sender.faults)
        assert in_order(came) and came[-1].seq == 19

    within(story())


def test_a_message_larger_than_the_receiver_takes_is_an_error() -> None:
    async def story() -> None:
        receiver = Receiver(lambda message: None, max_body_bytes=10)
        port = await receiver.listen()
        queue = PolicyQueue("afr", 4)
        queue.put(bytes(11), 11)
        with pytest.raises(BufgymError, match="message 0 of 11 bytes: the receiver takes at most 10"):
            await Sender(queue, lambda: TcpChannel.connect("127.0.0.1", port)).run()
        await receiver.close()

    within(story())


def test_a_receiver_that_hangs_up_before_the_goodbye_is_known_as_sent_is_no_fault() -> None:
    """As over a bus, whose ``publish`` returns late: everything is acked, so nothing is begun again."""

    class Hasty:
        """Acks at once; hangs up on a goodbye whose sending has not returned."""

        def __init__(self) -> None:
            self.answers: asyncio.Queue[Frame | None] = asyncio.Queue()

        async def send(self, frame: Frame) -> None:
            if frame.kind == GOODBYE:
                self.answers.put_nowait(None)
                await asyncio.sleep(10)
            self.answers.put_nowait(Frame(GREETING, 0, 1000) if frame.kind == GREETING else Frame(ACK, frame.number))

        async def receive(self) -> Frame:
            answer = await self.answers.get()
            if answer is None:
                raise ConnectionResetError("the peer has gone")
            return answer

        def left_bytes(self) -> int | None:
            return None

        def close(self) -> None:
            pass

    async def story() -> None:
        connections: list[Hasty] = []

        async def connect() -> Hasty:
            connections.append(Hasty())
            return connections[-1]

        queue = PolicyQueue("drop-oldest", 4)
        sender = Sender(queue, connect)
        queue.put(b"last words", 10)
        queue.close()
        await sender.run()
        assert len(connections) == 1 and not sender.faults

    within(story(), 5)


def test_a_slow_receiver_slows_the_sender_not_the_robot() -> None:
    async def story() -> None:
        came: list[Received] = []
        receiver = Receiver(slowly(came))
        port = await receiver.listen()
        queue = PolicyQueue("drop-oldest", 4)
        task = asyncio.create_task(Sender(queue, lambda: TcpChannel.connect("127.0.0.1", port)).run())
        await puts(queue, 60)
        queue.close()
        await task
        await receiver.close()
        assert in_order(came) and len(came) + queue.dropped == 60 and queue.dropped > 20 and came[-1].seq == 59

    within(story())


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
    assert all(replay(whole[:k]).differences == () for k in range(2, 100))  # wherever it breaks off
    assert replay(killed).differences == ()
    log.close()
    assert replay(path).differences == ()
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(BufgymError, match=r"empty\.mcap"):
        read_log(tmp_path / "empty.mcap")
    with pytest.raises(BufgymError, match=r"none\.mcap"):
        read_log(tmp_path / "none.mcap")


def test_what_comes_is_recorded(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    with Recording(tmp_path / "came.mcap") as recording:
        recording(Received("ab", 0, 7, 5_000, 1.5, 2, b"frame", 10**9))
    with (tmp_path / "came.mcap").open("rb") as file:
        found = {channel.topic: message for _, channel, message in make_reader(file).iter_messages()}
    assert found["/topic_2"].data == b"frame" and found["/topic_2"].sequence == 7
    assert b'"x": 1.5' in found["/received"].data and b'"size_bytes": 5' in found["/received"].data


def test_a_task_that_is_cancelled_takes_no_message_with_it() -> None:
    async def story() -> None:
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

    within(story())


def test_threads_put_and_take_at_once() -> None:
    queue = PolicyQueue("drop-newest", 50, clock=lambda: 0.0)
    came = []

    def take() -> None:
        came.extend(item.seq for item in queue)

    taker = threading.Thread(target=take)
    makers = [threading.Thread(target=lambda: [queue.put("frame", 1) for _ in range(500)]) for _ in range(3)]
    taker.start()
    for maker in makers:
        maker.start()
    for maker in makers:
        maker.join(30)
    queue.close()
    taker.join(30)
    assert not taker.is_alive()
    assert len(came) + queue.dropped == 1500 and came == sorted(set(came))


def test_a_port_that_is_taken_is_named() -> None:
    async def story() -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            port = taken.getsockname()[1]
            with pytest.raises(BufgymError, match=f"127.0.0.1:{port}"):
                await listener("127.0.0.1", port)

    within(story())


def test_headers_by_hand() -> None:
    frame = Frame(DATA, 3, 5, 7_000, 2.5, 1, b"abc")
    data = header(frame)
    assert len(data) == HEADER_BYTES
    assert parse(data, 10) == (frame._replace(body=b""), 3)
    with pytest.raises(FrameError, match="at most 2"):
        parse(data, 2)
    with pytest.raises(FrameError, match="at least"):
        parse(data[:-1], 10)

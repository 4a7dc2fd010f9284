"""The sending end: sends a ``PolicyQueue``'s messages, reports when each has left, and reconnects by itself."""

import asyncio
import os
import time
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Final, Literal

from bufgym.utils.errors import BufgymError
from bufgym_robot.channels import Channel
from bufgym_robot.frames import ACK, DATA, GOODBYE, GREETING, LATCHED, PING, STREAM_BYTES, Frame, FrameError
from bufgym_robot.latched import Latched
from bufgym_robot.path_watch import PathWatch
from bufgym_robot.path_window import PathWindow
from bufgym_robot.wire.queue import Item, PolicyQueue
from bufgym_robot.wire.tasks import until_one_ends

Leaves = Literal["sent", "acked", "written"]
"""Event at which a message has left.

"sent": the system wants more bytes, because it has sent nearly all of them. Where a library's socket is not found,
    the receiver's acks say when the next message is due (``PathWindow``).
"acked": the receiver has acked it. With the queue's ``window`` this is Robofleet's n_T.
"written": this system has taken it. That hides a queue in the system's buffers, and serves to measure what that costs.
"""

RETRY_S: Final = 0.5
PATIENCE_S: Final = 20.0  # Time for the receiver's answer to the greeting
_MOST_UNACKED: Final = 256  # limit on messages that await the receiver's ack, where they count as left before it


class Sender:
    """Sends the queue's messages in order, each once.

    After a broken connection it reconnects and resumes where the receiver says. Memory holds the queue and the messages
    that the receiver has not acked: those in flight, or at most the queue's window.
    """

    def __init__(
        self,
        queue: PolicyQueue,
        connect: Callable[[], Awaitable[Channel]],
        leaves: Leaves = "sent",
        on_status: Callable[[str], None] = lambda fault: None,
        latched: Latched | None = None,
    ) -> None:
        """``connect`` makes a new connection to the receiver at each call.

        ``latched`` has the states that go before the queue's messages at each connection, and between them later.

        ``on_status`` is called with "" when the receiver has answered, and with the reason when there is no connection,
        once for as long as the reason is the same.
        """
        if leaves not in ("sent", "acked", "written"):
            raise BufgymError(f"leaves = {leaves!r}: must be 'sent', 'acked' or 'written'")
        self.queue = queue
        self.connected = asyncio.Event()
        """Set while the receiver answers."""
        self.faults: deque[str] = deque(maxlen=100)
        """Reasons of the last 100 ends of a connection."""
        self._leaves, self._on_status = leaves, on_status
        self._path = PathWatch(connect, self._on_silence, self._ping)
        self._last_status: str | None = None
        self._stream = os.urandom(STREAM_BYTES)
        self._unacked: deque[Item] = deque()
        self._acked = asyncio.Event()
        self._latched = latched or Latched()
        self._receiver = 0  # its run
        self._writing = asyncio.Lock()
        self._window = PathWindow()
        self._max_body_bytes = 0
        self._next = 0  # the number of the message that the queue returns next
        self._left = 0  # messages reported to the queue as left
        self._silenced = False  # there was an answer before the silence
        self._said_goodbye = False  # then the receiver may hang up before we know that our goodbye was sent

    async def run(self) -> None:
        """Send until the queue is closed and all its messages are acked, or until cancelled.

        Raises:
            BufgymError: a message is larger than the receiver takes.
        """
        try:
            await self._run()
        finally:
            self._path.close()

    async def _run(self) -> None:
        while True:
            try:
                channel = await asyncio.wait_for(self._path.connected(), PATIENCE_S)
            except (OSError, TimeoutError) as error:
                self._note(error)
                await asyncio.sleep(RETRY_S)
                continue
            try:
                await until_one_ends(self._talk(channel), self._path.watch(channel))
                return
            except (OSError, TimeoutError) as error:
                self._note(error)
            finally:
                self.queue.left_bytes = lambda: None
                self.connected.clear()
                channel.close()
            if not self._path.ready:
                await asyncio.sleep(RETRY_S)

    def _note(self, error: Exception) -> None:
        self.faults.append(_words(error))
        self._tell(self.faults[-1])

    def _on_silence(self, silence: Exception | None) -> None:
        """Tell that nothing is heard, or that the same connection is heard again."""
        if silence is not None:
            self._silenced = self.connected.is_set()
            self.connected.clear()
            self._tell(_words(silence))
        elif self._silenced:
            self.connected.set()
            self._tell("")

    def _tell(self, fault: str) -> None:
        if fault != self._last_status:
            self._last_status = fault
            self._on_status(fault)

    async def _talk(self, channel: Channel) -> None:
        """Greet, then send until all is done."""
        await self._greet(channel)
        self.connected.set()
        self._tell("")
        self.queue.left_bytes = channel.left_bytes
        await self._converse(channel)

    async def _greet(self, channel: Channel) -> None:
        """Name the stream; skip messages that the receiver already has."""
        first = self._unacked[0].number if self._unacked else self._next
        asked_s = time.monotonic()
        await channel.send(Frame(GREETING, first, body=self._stream))
        answer = await asyncio.wait_for(channel.receive(), PATIENCE_S)
        self._window = PathWindow(time.monotonic() - asked_s)
        if answer.kind != GREETING or answer.seq < 1:
            raise FrameError(f"frame of kind {answer.kind}: must be the answer to the greeting, and take messages")
        self._max_body_bytes = answer.seq
        if answer.at_us != self._receiver:
            self._receiver = answer.at_us
            self._latched.owe_all()
        while self._unacked and self._unacked[0].number < answer.number:
            self._take_ack()

    async def _converse(self, channel: Channel) -> None:
        """Send and take acks until all is done."""
        begun = asyncio.Event()
        states, messages = self._send_states(channel, begun), self._send_all(channel, begun)
        try:
            await until_one_ends(messages, states, self._take_acks(channel))
        except (OSError, TimeoutError):
            if not self._said_goodbye:
                raise

    async def _send_states(self, channel: Channel, begun: asyncio.Event) -> None:
        """Send states as they come; ``begun`` is set once all that were owed at first are sent."""
        number, first = -1, self._latched.number
        while True:
            state = self._latched.owed(number)
            if state is None or state.number >= first:
                begun.set()
            state = await self._latched.next(number)
            number = state.number
            frame = Frame(LATCHED, number, state.source, state.at_us, 0.0, state.topic, state.message)
            await self._write(channel, frame)

    async def _write(self, channel: Channel, frame: Frame) -> None:
        async with self._writing:
            await channel.send(frame)

    async def _ping(self, channel: Channel) -> None:
        if self.connected.is_set() and not self._writing.locked():
            await self._write(channel, Frame(PING, 0))

    async def _send_all(self, channel: Channel, begun: asyncio.Event) -> None:
        await begun.wait()
        for unacked in list(self._unacked):
            await self._send(channel, unacked)
        while (item := await self.queue.aget()) is not None:
            self._unacked.append(item)
            self._next = item.number + 1
            await self._send(channel, item)
            while len(self._unacked) >= _MOST_UNACKED:
                await self._an_ack()
        while self._unacked or self._latched.owed() is not None:
            await self._an_ack()
        self._said_goodbye = True
        await self._write(channel, Frame(GOODBYE, 0))

    async def _send(self, channel: Channel, item: Item) -> None:
        if len(item.message) > self._max_body_bytes:
            raise BufgymError(
                f"message {item.seq} of {len(item.message)} bytes: the receiver takes at most {self._max_body_bytes}"
            )
        self._window.sends(item.number, time.monotonic())
        frame = Frame(DATA, item.number, item.seq, item.at_us, item.x, item.topic, item.message)
        await self._write(channel, frame)
        if self._leaves == "sent" and not await channel.until_wanted():
            while len(self._unacked) >= self._window.messages:
                await self._an_ack()
        if self._leaves != "acked":
            self._leave(item)

    async def _an_ack(self) -> None:
        """Wait until the next ack has come."""
        self._acked.clear()
        await self._acked.wait()

    async def _take_acks(self, channel: Channel) -> None:
        """Read acks for ever: of latched messages by number, of the others in the order in which they were sent.

        Raises:
            FrameError: the other end sent anything else.
        """
        while True:
            frame = await channel.receive()
            if frame.kind == LATCHED:
                self._latched.ack(frame.number)
                self._acked.set()
                continue
            if frame.kind != ACK or not self._unacked or frame.number != self._unacked[0].number:
                raise FrameError(f"frame of kind {frame.kind}, number {frame.number}: must be the next ack")
            self._window.acked(frame.number, self._unacked[0].size_bytes, time.monotonic())
            self._take_ack()

    def _take_ack(self) -> None:
        """Let the oldest unacked message go, and wake who waits for an ack."""
        self._leave(self._unacked.popleft())
        self._acked.set()

    def _leave(self, item: Item) -> None:
        """Tell the queue once that a message has left, so that it gives the next."""
        if item.number >= self._left:
            self._left = item.number + 1
            self.queue.gone()


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"

"""Messages to one client, the most urgent first.

Stops go first, then the relay's answers, then no_drop messages while fewer than n_T are unacked, then messages from the
queues. A message that comes to an idle connection is sent at once, in its sender's turn.
"""

import asyncio
from collections import deque
from collections.abc import Collection
from typing import Final

from websockets.exceptions import WebSocketException

from bufgym_relay.caller import Caller
from bufgym_relay.member import Member
from bufgym_relay.outgoing import Outgoing
from bufgym_relay.stored import NOT_REACHED
from bufgym_relay.subscriber import Lane, Subscription, make_one, next_lane
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import WireError

LARGE_BYTES: Final = 2**16  # Size of a message beyond which its writing takes long
MAX_ANSWERS: Final = 4_096  # Limit on unsent answers; a client that asks on without reading is closed


class Outbox:
    """The only part that writes to a connection: its task, or ``offered`` while the task has nothing to do."""

    def __init__(self, caller: Caller, member: Member, form: str, received: int) -> None:
        """``form`` says how its messages are written; the client has no_drop messages up to ``received``."""
        self._hub, self._caller, self._socket = caller.hub, caller, caller.socket
        self._awake, self._is_idle = asyncio.Event(), False
        self._leaving: Lane | None = None  # the one with a message of which the system has not all
        self._member, self._form = member, form
        self._sent_number = received
        self._in_flight: deque[int] = deque()
        self.urgent: dict[str, Outgoing] = {}
        """Topic -> its last stop, which waits for nothing."""
        self._in_turn = False  # whether what waits may be large
        self._fetching: asyncio.Future[tuple[int, str, bytes]] | None = None

    def wake(self) -> None:
        """Look for something to send."""
        self._awake.set()

    def offered(self, size_bytes: int) -> None:
        """Look for what came into the queues, so large: at once if nothing else waits, or have the task do it."""
        if size_bytes > LARGE_BYTES:
            self._in_turn = True
            self._awake.set()
            return
        # While the task waits and nobody has woken it, no stop, answer or no_drop message could go first.
        if not (self._is_idle and not self._awake.is_set() and self._socket.takes_more and self._sent_at_once()):
            self._awake.set()

    def _sent_at_once(self) -> bool:
        """Send the next message of the queues; return whether it has left and is the last."""
        try:
            lane = self._write_queued(self._member.subscriptions.values())
        except Exception as error:  # must not end the sender's turn: it is the fault of this connection
            self._socket.transport.abort()
            asyncio.get_running_loop().call_exception_handler({"message": "a relay's outbox", "exception": error})
            return True
        return lane is not None and not lane.carried and not lane.ready

    def acked(self, number: int) -> None:
        """Note that the client has processed all no_drop messages up to this number."""
        if number > self._sent_number:
            raise WireError(f"ack of {number}: must be at most {self._sent_number}, the last sent")
        while self._in_flight and self._in_flight[0] <= number:
            self._in_flight.popleft()
        self._awake.set()

    async def run(self) -> None:
        """Send messages one after the other."""
        try:
            while True:
                self._is_idle = True
                await self._awake.wait()
                self._awake.clear()
                self._is_idle = False
                while await self.one():
                    pass
        except (WebSocketException, OSError):
            pass  # the reader sees it too
        except Exception:
            self._socket.transport.abort()
            raise

    async def one(self) -> bool:
        """Send the next message; return whether there was one."""
        await self._left()
        while self.urgent:
            # Taken out before the wait: a newer stop that comes during it must go out, too.
            await self._send(self.urgent.pop(next(iter(self.urgent))))
        if self._caller.answers:
            await self._caller.send_answers()
        member = self._member
        if self._sent_number < member.session.numbered and await self._no_drop(member):
            return True
        subscriptions = list(member.subscriptions.values())
        made = await make_one(subscriptions, self._hub.making)
        await self._socket.until_open()
        if self._in_turn:
            # A turn of the event loop for each: a stop is read, and goes, between two large ones.
            async with self._hub.writing:
                wrote = self.urgent or self._write_queued(subscriptions) is not None
                await asyncio.sleep(0)
        else:
            wrote = self._write_queued(subscriptions) is not None
        if not wrote:
            self._in_turn = False
            return made
        await self._left()
        return True

    def _write_queued(self, subscriptions: Collection[Subscription]) -> Lane | None:
        """Write the next message of the queues; return its lane, ``carried`` until the system has all of it."""
        now_s = self._hub.clock()
        lane = next_lane(subscriptions, now_s)
        item = None if lane is None else lane.take(now_s)
        if lane is None or item is None:
            return None
        if not self._hub.orders.is_over(item.message.message, self._hub.now_us()):
            self._socket.transport.write(item.message.frame(self._form))
            self._member.sent += 1
        # After the send: until then the policy counts these bytes as still to leave.
        if self._socket.paused:
            self._leaving = lane
        else:
            lane.gone()
        return lane

    async def _left(self) -> None:
        """Wait until the system has all that was written."""
        await self._socket.drain()
        if self._leaving is not None:
            self._leaving.gone()
            self._leaving = None

    async def _no_drop(self, member: Member) -> bool:
        """Send the no_drop message that was fetched; have the next one fetched if the window has room for it."""
        if self._fetching is None:
            if len(self._in_flight) < self._hub.config.store.window:
                self._fetching = self._hub.store.next(member.session, self._sent_number)
                self._fetching.add_done_callback(lambda _: self.wake())
            return False
        # Messages from the queues go on while the disk looks.
        if not self._fetching.done():
            return False
        (self._sent_number, topic, frame), self._fetching = self._fetching.result(), None
        if not frame:
            pass  # all up to this number have gone
        else:
            message = wire.decode(frame, len(frame))._replace(seq=self._sent_number)
            over = self._hub.orders.is_over(message, self._hub.now_us())
            if member.permissions.allow("receive", topic) and not over:
                self._in_flight.append(self._sent_number)
                member.session.sent = max(member.session.sent, self._sent_number)
                await self._send(Outgoing(message))
            else:
                late = over and self._hub.orders.is_late(message, self._hub.now_us())
                why = NOT_REACHED if late else "withdrawn by a stop" if over else "no rule lets its robot have it"
                self._hub.store.denied(
                    member.session, self._sent_number, member.session.why_not(self._sent_number, why)
                )
        return True

    async def _send(self, outgoing: Outgoing) -> None:
        await self._socket.send_frame(outgoing.frame(self._form))
        self._member.sent += 1

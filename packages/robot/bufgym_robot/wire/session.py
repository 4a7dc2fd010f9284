"""A session at a relay: keeps a connection, subscribes, and sends commands that arrive exactly once.

This is all that a viewer needs. ``fleet.client.RobotClient`` adds a queue for a robot's messages.

Of several relays that share topics, the first is the client's home. While it is away, the next one that answers stands
in for it: messages and subscriptions go over that one until home is back. No_drop messages and durable subscriptions
wait for home, which alone knows what has arrived.
"""

import asyncio
import contextlib
import os
import re
import ssl
import time
from collections import deque
from collections.abc import Callable, Container, Coroutine
from typing import Any, Final
from urllib.parse import SplitResult

from bufgym_robot.wire import address
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.backoff import Backoff
from bufgym_robot.wire.deadlines import Deadlines
from bufgym_robot.wire.inbox import Inbox
from bufgym_robot.wire.orders import is_stop
from bufgym_robot.wire.patterns import Pattern, pattern
from bufgym_robot.wire.stops import Stops
from bufgym_robot.wire.tasks import Tasks, until_one_ends
from bufgym_robot.wire.unanswered import Unanswered
from bufgym_robot.wire.wanted import OnMessage, Wanted

MOST_WHYS: Final = 64  # Refused commands of which a new connection tells
PATIENCE_S: Final = 5.0  # Time to wait for a connection, and for the relay's welcome
_FOR_GOOD: Final = ("unauthorized", "wrong")  # Codes of refusals that no waiting fixes


class HomeIsBack(Exception):  # noqa: N818  (nothing is wrong)
    """The first relay is back, and this connection is to another."""


class Session:
    """One name at a relay, over as many connections as needed."""

    def __init__(
        self,
        url: str,
        name: str,
        *,
        robot: str = "",
        token: str | Callable[[], str | None] | None = None,
        tls: ssl.SSLContext | None = None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """
        Args:
            robot: name of the robot that this is; commands to that robot wait for this session, and no other has it.
            url: the relay's, ``ws://HOST:PORT`` or ``wss://HOST:PORT``; of several with commas between them, the
                first is home, and the others stand in while it is away.
            name: sender's name as others see it.
            token: proof of identity if the relay wants one, or a function that reads it for each connection, such as
                ``address.token``; once let in, a client waits for the next token when one has ended.
            tls: for ``wss``, with a client's certificate if the relay knows it by that (default: the system's).
            say: called with a line for each refusal and each connection's end.
        """
        self._addresses = [address.parsed(one.strip()) for one in url.split(",")]
        self._at, self._home = 0, Backoff()
        self.name, self.robot = name, robot
        self.connected = asyncio.Event()
        """Set while the relay has accepted the connection."""
        self.ready = asyncio.Event()
        """Set while the relay has also accepted all subscriptions."""
        self.welcome: dict[str, Any] = {}
        """The relay's last welcome."""
        self.faults: deque[str] = deque(maxlen=100)
        """The last 100 refusals and reasons for a connection's end."""
        self.round_trip_s: float | None = None
        """Round trip to the relay as ``ping`` last measured it, including messages on their way."""
        self.deadlines = Deadlines()
        self.late: Callable[[wire.Message], None] = lambda message: self.note(f"{message.topic}: came too late")
        """Called with a command that came after its deadline, in place of ``on_message``."""
        self.reads_on = False
        """Whether messages are read on while the program is at work on one, so that a stop overtakes them."""
        self.begun: Container[int] = ()
        """Numbers of commands that the program has begun: one that comes again after a break is not late."""
        self._token, self._tls, self._report = token, tls, say
        self._session = f"{re.sub('[^A-Za-z0-9._-]', '-', name)[:40]}-{os.urandom(8).hex()}"
        self._no_drop: tuple[Pattern, ...] = ()
        self._unanswered = Unanswered(self.deadlines.dated)
        self._stops = Stops(self.deadlines.dated, self._session)
        self._inbox = Inbox()
        self._wanted = asyncio.Event()
        self._received = [0, 0]  # number of the last no_drop message from home and from the relay that stands in
        self._whys: dict[str, str] = {}  # number of a no_drop message from home -> why it was not executed
        self._subscriptions = Wanted()
        self._connection: Any = None
        self._tasks = Tasks()

    @property
    def address(self) -> SplitResult:
        """The relay that it is connected to, or tries."""
        return self._addresses[self._at]

    @property
    def stands_in(self) -> bool:
        """Whether that is another than its home."""
        return self._at > 0

    async def command(self, topic: str, data: Any, type: str = "") -> None:
        """Send ``data`` on a no_drop topic; it arrives exactly once.

        A command to a robot has the deadline of the relay's rule (``command_s``), counted from this call; this returns
        once the robot has executed it. On any other topic it returns once the relay holds it. With a ROS ``type``, such
        as ``geometry_msgs/msg/Twist``, data are bytes in CDR; otherwise they are sent as JSON.

        Raises:
            BufgymError: it is no JSON, or the relay or the robot refused it, or it did not reach the robot in time; the
                error says which, and why. After a fault of the relay nobody may know.
        """
        encoding = "cdr" if type else "json"
        payload = data if type else wire.written(topic, data)
        message = wire.Message(topic, payload, encoding, type, stamp_us=time.time_ns() // 1000, no_drop=True)
        self.check_size(message)
        answered = self._unanswered.put(message)
        self._wanted.set()
        self._inbox.look()
        await answered

    async def stop(self, robot: str) -> str:
        """Stop a robot and return once the relay has it; ``release`` needs the returned id. The stop holds."""
        self._unanswered.withdraw(robot, "withdrawn by a stop")
        return await self._order(robot, command="stop")

    async def release(self, robot: str, of: str) -> None:
        """Release a robot from the stop with this id, which its status says, too; this has a deadline."""
        await self._order(robot, command="release", of=of)

    async def _order(self, robot: str, **said: str) -> str:
        id, answered = self._stops.put(robot, **said)
        if self.connected.is_set():
            with contextlib.suppress(Exception):  # as in ``run``, which notes it, and says it again later
                await self._stops.send(self._connection.send)
        await answered
        return id

    def subscribe(
        self,
        pattern: str,
        on_message: OnMessage,
        *,
        policy: str | None = None,
        capacity: int | None = None,
        durable: bool = False,
    ) -> None:
        """Call ``on_message`` for each message on topics that contain ``pattern``, as far as the rules allow.

        ``policy`` and ``capacity`` describe the relay's queue for this subscription. With ``durable`` the relay holds
        no_drop messages while this client is away.
        """
        chosen = {"policy": policy, "capacity": capacity, "durable": durable or None}
        fields = self._subscriptions.add(pattern, on_message, **chosen)
        self.ready.clear()
        if self.connected.is_set() and not (self.stands_in and durable):
            self._tasks.begin(self._say_it("subscribe", **fields))

    async def run(self) -> None:
        """Connect, and again whenever the connection ends or could not be made, until cancelled.

        Raises:
            RefusedError: the relay does not let this client in, and waiting does not fix it: a wrong key or name.
        """
        backoff = Backoff()
        try:
            while True:
                try:
                    await self._serve_one_connection(backoff)
                except HomeIsBack:
                    self._at = 0
                    continue
                except wire.RefusedError as refused:
                    next_token = callable(self._token) and self.welcome and refused.code == "unauthorized"
                    if refused.code in _FOR_GOOD and not (self.stands_in or next_token):
                        raise
                    self.note(str(refused))
                    away = False
                except Exception as error:  # closing connections raise many kinds, also by faults of libraries
                    # A relay that refuses this address says why in its HTTP answer.
                    page = getattr(getattr(error, "response", None), "body", None) or b""
                    self.note(f"{type(error).__name__}: {error} {page.decode(errors='replace')}".strip())
                    away = not page and isinstance(error, OSError)
                self._at = (self._at + 1) % len(self._addresses)
                if not self.stands_in:
                    await asyncio.sleep(backoff.delay_s(away))
        finally:
            for waiting in (self._unanswered, self._stops):
                waiting.give_up(f"{self.name}: the client has ended")
            await self._tasks.end()

    async def _serve_one_connection(self, backoff: Backoff) -> None:
        """Connect to the relay whose turn it is, and work until the connection ends."""
        try:
            async with asyncio.timeout(PATIENCE_S):
                self._connection = await self._connect()
                await self._greet()
            backoff.connected()
            if not self.stands_in:
                self._home.connected()
            await until_one_ends(*self._works())
        finally:
            self.connected.clear()
            self.ready.clear()
            self._subscriptions.confirmed.clear()
            # Taken out first: others look at it to see whether there is one.
            connection, self._connection = self._connection, None
            with contextlib.suppress(AttributeError):  # there is none; or asyncio's of 3.11, if it has ended already
                connection.transport.abort()

    def check_size(self, message: wire.Message) -> int:
        """Return the bytes of a message's frame.

        Raises RefusedError: they are more than the relay takes, as far as its last welcome says.
        """
        size_bytes, most = len(wire.encode(message)), self.welcome.get("max_message_bytes", wire.MAX_FRAME_BYTES)
        if size_bytes > most:
            raise wire.RefusedError("too_large", f"topic {message.topic}: {size_bytes} bytes: must be at most {most}")
        return size_bytes

    def note(self, fault: str) -> None:
        """Report a fault, once however often it comes in a row."""
        if not self.faults or self.faults[-1] != fault:
            with contextlib.suppress(Exception):  # a closed pipe, which is no reason to end
                self._report(f"{self.name}: {fault}")
        self.faults.append(fault)

    async def _connect(self) -> Any:
        from bufgym_robot.wire.client_connection import connected  # not at start-up

        return await connected(self.address, self._tls)

    async def _say_it(self, op: str, **fields: Any) -> None:
        await self._connection.send(wire.say(op, **fields))

    async def _greet(self) -> None:
        hello: dict[str, Any] = {"version": wire.VERSION, "name": self.name, "form": "binary"}
        if (token := self._token() if callable(self._token) else self._token) is not None:
            hello["token"] = token
        if self.stands_in:  # for a session that ends with the connection
            self._received[1] = 0
        else:
            hello |= {"session": self._session, "received": self._received[0], "acked": self._unanswered.acked}
            more = {"robot": self.robot, "open": self._unanswered.open, "whys": self._whys}
            hello |= {name: value for name, value in more.items() if value}
        self.deadlines.begin()
        await self._say_it("hello", **hello)
        said = wire.heard(await self._connection.recv())
        if said["op"] == "refused":
            raise wire.RefusedError(said["code"], f"{self.address.geturl()}: refused: {said['code']}: {said['why']}")
        if said["op"] != "welcome":
            raise wire.WireError(f"op {said['op']!r}: must be welcome")
        self.welcome = said
        self.deadlines.welcomed(said)
        await self._stops.send(self._connection.send)
        self._no_drop = tuple(map(pattern, said.get("no_drop", ())))
        if not self.stands_in:
            self._unanswered.resume(said["received"], max(1, said["window"]), self.check_size)
        for subscription in self._subscriptions.asked(self.stands_in):
            await self._say_it("subscribe", **subscription.fields)
        self.connected.set()
        self._confirm()

    def _confirm(self) -> None:
        if self._subscriptions.are_confirmed(self.stands_in):
            self.ready.set()

    def _works(self) -> list[Coroutine[Any, Any, None]]:
        """List the tasks that run while there is a connection."""
        self._inbox = Inbox(lambda: self.reads_on or (self._unanswered.awaited and not self.stands_in))
        first = self._until_home() if self.stands_in else self._send_no_drop()
        return [first, self._hear_all(), self._take_all(), self.deadlines.ask(self._say_it)]

    async def _until_home(self) -> None:
        while True:
            await asyncio.sleep(self._home.delay_s(away=True))
            with contextlib.suppress(OSError, TimeoutError):
                async with asyncio.timeout(PATIENCE_S):
                    (await address.reached(self._addresses[0])).close()
                raise HomeIsBack

    async def _send_no_drop(self) -> None:
        while True:
            while (message := self._unanswered.next()) is not None:
                await self._connection.send(wire.encode(message))
            self._wanted.clear()
            await self._wanted.wait()

    async def _hear_all(self) -> None:
        async for frame in self._connection:
            if isinstance(frame, bytes):
                message = wire.decode(frame)
                if message.at_us:
                    self.deadlines.clock.heard(message.at_us)
                # A stop waits behind nothing.
                await (self._take if is_stop(message.topic) else self._inbox.put)(message)
            else:
                self._answer(wire.heard(frame))
        raise ConnectionResetError("the relay has closed the connection")

    async def _take_all(self) -> None:
        async for message in self._inbox:
            await self._take(message)

    async def _take(self, message: wire.Message) -> None:
        if message.no_drop and message.seq <= self._received[self.stands_in]:
            return  # it came before the connection broke
        if self.deadlines.is_late(message) and message.number not in self.begun:
            self.late(message)
            why = "came too late"
        else:
            why = await self._subscriptions.call(message)
        if message.no_drop:
            self._received[self.stands_in] = message.seq
            if why and not self.stands_in:
                self._whys[str(message.seq)] = why[:300]
                self._whys = dict(list(self._whys.items())[-MOST_WHYS:])
            # After the program has had it: if the connection breaks before, the relay sends it again.
            await self._say_it("ack", seq=message.seq, **({"why": why} if why else {}))

    def _answer(self, said: dict[str, Any]) -> None:
        if said["op"] == "ack":
            self._unanswered.ack(said["seq"])
        elif said["op"] == "delivered":
            self._unanswered.delivered(said["seq"], said.get("why", ""))
        elif said["op"] == "clock":
            self.deadlines.answered(said)
        elif said["op"] == "stopped":
            self._stops.confirm(said["topic"], said["id"])
        elif said["op"] == "subscribed":
            self._subscriptions.confirmed.add(said["id"])
            self._confirm()
        elif said["op"] == "refused":
            why = wire.RefusedError(said["code"], f"topic {said.get('topic')}: refused: {said['code']}: {said['why']}")
            if is_stop(str(said.get("topic"))):
                self._stops.refuse(said.get("seq", 0), why)
            elif said["what"] == "publish" and self._unanswered.expects(said.get("topic", ""), said.get("seq")):
                self._unanswered.refuse(said["code"], said["why"])
            elif said["what"] == "subscribe" and said["code"] not in _FOR_GOOD:
                raise ConnectionResetError(f"subscribe refused: {said['code']}: {said['why']}")  # and once more
            else:
                self.note(f"{said['what']} refused: {said['code']}: {said['why']}")
        self._wanted.set()

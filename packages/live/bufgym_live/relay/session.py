"""A session at a relay: keeps a connection, subscribes, and sends commands that arrive exactly once.

This is all that a viewer needs. ``client.RobotClient`` adds a queue for a robot's messages.

Of several relays that share topics, the first is the client's home. While it is away, the next one that answers stands
in for it: messages and subscriptions go over that one until home is back. No_drop messages and durable subscriptions
wait for home, which alone knows what has arrived.
"""

import asyncio
import contextlib
import inspect
import json
import os
import re
import ssl
import time
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import SplitResult

from bufgym.ground.errors import BufgymError
from bufgym.ground.files import read_utf8
from bufgym_live.relay import address, wire
from bufgym_live.relay.backoff import Backoff
from bufgym_live.relay.unanswered import Unanswered
from bufgym_live.relay.wire import RefusedError
from bufgym_live.robot.sockets import unsent_bytes
from bufgym_live.robot.tasks import Tasks, until_one_ends

TOKEN_VARIABLE: Final = "BUFGYM_RELAY_TOKEN"
PATIENCE_S: Final = 5.0  # Time to wait for a connection, and for the relay's welcome
_MAX_TOKEN_BYTES: Final = 2**16
_MAX_FRAME_BYTES: Final = 2**26
_PASSING: Final = ("store_full", "too_fast")  # Codes of refusals after which it is tried again

OnMessage = Callable[[wire.Message], Awaitable[None] | None]


class HomeIsBack(Exception):  # noqa: N818  (nothing is wrong)
    """The first relay is back, and this connection is to another."""


class SubscriptionRequest(NamedTuple):
    """A subscription that is asked of the relay."""

    pattern: re.Pattern[str]
    on_message: OnMessage
    fields: dict[str, Any]


def token(path: str | Path | None = None) -> str | None:
    """Read the token from this file or from the environment's ``BUFGYM_RELAY_TOKEN``; None without either."""
    if path is not None:
        return read_utf8(path, _MAX_TOKEN_BYTES).strip()
    return os.environ.get(TOKEN_VARIABLE) or None


def security(authority: str | None = None, certificate: str | None = None) -> ssl.SSLContext | None:
    """Set up TLS for ``wss`` from PEM files: the relay's authority, and the client's certificate with its key."""
    if authority is None and certificate is None:
        return None
    try:
        context = ssl.create_default_context(cafile=authority)
        if certificate is not None:
            context.load_cert_chain(certificate)
    except (OSError, ssl.SSLError) as error:
        raise BufgymError(f"{certificate or authority}: no certificate: {error}") from None
    return context


class Session:
    """One name at a relay, over as many connections as needed."""

    def __init__(
        self,
        url: str,
        name: str,
        *,
        token: str | None = None,
        tls: ssl.SSLContext | None = None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """
        Args:
            url: the relay's, ``ws://HOST:PORT`` or ``wss://HOST:PORT``; of several with commas between them, the
                first is home, and the others stand in while it is away.
            name: sender's name as others see it.
            token: proof of identity if the relay wants one; ``token()`` finds it.
            tls: for ``wss``, with a client's certificate if the relay knows it by that (default: the system's).
            say: called with a line for each refusal and each connection's end.
        """
        self._addresses = [address.parsed(one.strip()) for one in url.split(",")]
        self._at, self._home = 0, Backoff()
        self.name = name
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
        self._token, self._tls, self._report = token, tls, say
        self._session = f"{re.sub('[^A-Za-z0-9._-]', '-', name)[:40]}-{os.urandom(8).hex()}"
        self._no_drop: tuple[re.Pattern[str], ...] = ()
        self._unanswered = Unanswered()
        self._wanted = asyncio.Event()
        self._received = [0, 0]
        """Number of the last no_drop message received from home and from the relay that stands in."""
        self._subscriptions: dict[str, SubscriptionRequest] = {}
        self._confirmed: set[str] = set()
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
        """Send ``data`` on a no_drop topic and wait until the relay holds it; it arrives exactly once.

        With a ROS ``type``, such as ``geometry_msgs/msg/Twist``, data are bytes in CDR; otherwise they are sent as
        JSON.

        Raises:
            BufgymError: the relay refused it; the error says why.
        """
        encoding = "cdr" if type else "json"
        payload = data if type else json.dumps(data, separators=(",", ":"), allow_nan=False).encode()
        message = wire.Message(topic, payload, encoding, type, stamp_us=time.time_ns() // 1000, no_drop=True)
        answered = self._unanswered.put(message)
        self._wanted.set()
        await answered

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
        id = str(len(self._subscriptions))
        chosen = {"policy": policy, "capacity": capacity, "durable": durable or None}
        fields = {"id": id, "topic": pattern, **{key: value for key, value in chosen.items() if value is not None}}
        try:
            self._subscriptions[id] = SubscriptionRequest(re.compile(pattern), on_message, fields)
        except re.error as error:
            raise BufgymError(f"subscription {pattern!r}: no regular expression: {error}") from None
        self.ready.clear()
        if self.connected.is_set() and not (self.stands_in and durable):
            self._tasks.begin(self._say_it("subscribe", **fields))

    async def run(self) -> None:
        """Connect, and again whenever the connection ends, until cancelled.

        Raises:
            RefusedError: the relay does not let this client in.
        """
        from websockets.exceptions import WebSocketException

        backoff = Backoff()
        try:
            while True:
                try:
                    await self._serve_one_connection(backoff)
                except HomeIsBack:
                    self._at = 0
                    continue
                except RefusedError as refused:
                    if not self.stands_in:
                        raise
                    self.note(str(refused))
                except (OSError, TimeoutError, wire.WireError, WebSocketException) as error:
                    # A relay that refuses this address says why in its HTTP answer.
                    page = getattr(getattr(error, "response", None), "body", None) or b""
                    self.note(f"{type(error).__name__}: {error} {page.decode(errors='replace')}".strip())
                self._at = (self._at + 1) % len(self._addresses)
                if not self.stands_in:
                    await asyncio.sleep(backoff.delay_s())
        finally:
            self._unanswered.give_up(f"{self.name}: the client has ended")
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
            self._confirmed.clear()
            if self._connection is not None:
                self._connection.transport.abort()
                self._connection = None

    def note(self, fault: str) -> None:
        """Report a fault, once however often it comes in a row."""
        if not self.faults or self.faults[-1] != fault:
            self._report(f"{self.name}: {fault}")
        self.faults.append(fault)

    async def _connect(self) -> Any:
        from websockets.asyncio.client import connect
        from websockets.typing import Subprotocol

        secure = self.address.scheme == "wss"
        return await connect(
            f"{self.address.scheme}://{self.address.netloc}{wire.PATH}",
            sock=await address.reached(self.address),
            subprotocols=[Subprotocol(wire.SUBPROTOCOL)],
            ssl=(self._tls or ssl.create_default_context()) if secure else None,
            server_hostname=self.address.hostname if secure else None,
            compression=None,
            ping_interval=None,  # a slow link answers late; TCP_USER_TIMEOUT finds a dead one
            proxy=None,
            max_size=_MAX_FRAME_BYTES,
            write_limit=(1, 0),
        )

    async def _say_it(self, op: str, **fields: Any) -> None:
        await self._connection.send(wire.say(op, **fields))

    async def _greet(self) -> None:
        hello: dict[str, Any] = {"version": wire.VERSION, "name": self.name, "form": "binary"}
        if self._token is not None:
            hello["token"] = self._token
        if self.stands_in:  # for a session that ends with the connection
            self._received[1] = 0
        else:
            hello |= {"session": self._session, "received": self._received[0], "acked": self._unanswered.acked}
        await self._say_it("hello", **hello)
        said = wire.heard(await self._connection.recv())
        if said["op"] == "refused":
            raise RefusedError(said["code"], f"{self.address.geturl()}: refused: {said['code']}: {said['why']}")
        if said["op"] != "welcome":
            raise wire.WireError(f"op {said['op']!r}: must be welcome")
        self.welcome = said
        self._no_drop = tuple(re.compile(pattern) for pattern in said.get("no_drop", ()))
        if not self.stands_in:
            self._unanswered.resume(said["received"], max(1, said["window"]))
        for subscription in self._asked:
            await self._say_it("subscribe", **subscription.fields)
        self.connected.set()
        self._confirm()

    @property
    def _asked(self) -> list[SubscriptionRequest]:
        """The subscriptions that this relay is asked for."""
        return [one for one in self._subscriptions.values() if not (self.stands_in and "durable" in one.fields)]

    def _confirm(self) -> None:
        if self._confirmed.issuperset(one.fields["id"] for one in self._asked):
            self.ready.set()

    def _works(self) -> list[Coroutine[Any, Any, None]]:
        """List the tasks that run while there is a connection."""
        return [self._until_home() if self.stands_in else self._send_no_drop(), self._take_all()]

    async def _until_home(self) -> None:
        while True:
            await asyncio.sleep(self._home.delay_s())
            with contextlib.suppress(OSError, TimeoutError):
                async with asyncio.timeout(PATIENCE_S):
                    (await address.reached(self._addresses[0])).close()
                raise HomeIsBack

    def _left_bytes(self) -> int | None:
        connection = self._connection
        if connection is None:
            return None
        unsent = unsent_bytes(connection.transport.get_extra_info("socket"))
        return None if unsent is None else connection.transport.get_write_buffer_size() + unsent

    async def _send_no_drop(self) -> None:
        while True:
            while (message := self._unanswered.next()) is not None:
                await self._connection.send(wire.encode(message))
            self._wanted.clear()
            await self._wanted.wait()

    async def ping(self) -> None:
        """Measure ``round_trip_s``, unless the connection ends before the answer."""
        from websockets.exceptions import WebSocketException

        with contextlib.suppress(WebSocketException):
            if self._connection is not None:
                self.round_trip_s = await (await self._connection.ping())

    async def _take_all(self) -> None:
        async for frame in self._connection:
            if isinstance(frame, bytes):
                await self._take(wire.decode(frame, _MAX_FRAME_BYTES))
            else:
                self._answer(wire.heard(frame))
        raise ConnectionResetError("the relay has closed the connection")

    async def _take(self, message: wire.Message) -> None:
        if message.no_drop and message.seq <= self._received[self.stands_in]:
            return  # it came before the connection broke
        for subscription in list(self._subscriptions.values()):
            if subscription.pattern.search(message.topic):
                done = subscription.on_message(message)
                if inspect.isawaitable(done):
                    await done
        if message.no_drop:
            self._received[self.stands_in] = message.seq
            await self._say_it("ack", seq=message.seq)

    def _answer(self, said: dict[str, Any]) -> None:
        if said["op"] == "ack":
            self._unanswered.ack(said["seq"])
        elif said["op"] == "subscribed":
            self._confirmed.add(said["id"])
            self._confirm()
        elif said["op"] == "refused":
            if said["what"] == "publish" and self._unanswered.expects(said.get("topic", ""), said.get("seq")):
                self._unanswered.refuse(said["code"], said["why"])
            elif said["what"] == "subscribe" and said["code"] in _PASSING:
                raise ConnectionResetError(f"subscribe refused: {said['code']}: {said['why']}")  # and once more
            else:
                self.note(f"{said['what']} refused: {said['code']}: {said['why']}")
        self._wanted.set()

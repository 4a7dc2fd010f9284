"""Relays that share topics over NATS, so that robots at one of them reach viewers at another.

A message published at one relay goes through a queue to all others, and from there to clients that *their* rules allow.
Rules with ``nats = true`` say which topics a relay gives to the others, and which it takes from them.

A no_drop message goes into a JetStream stream before it is acked. Each relay takes it from there and holds it for its
own receivers. NATS keeps it until every relay has taken it, also one that is away.
"""

import asyncio
import hashlib
import ssl
from typing import Any, Final

from bufgym.ground.errors import BufgymError
from bufgym.relay import policies, protocol, wire
from bufgym.relay.config import DEFAULT_CAPACITY, Nats
from bufgym.relay.hub import OWN, Hub, Outgoing
from bufgym.relay.patterns import pattern
from bufgym.relay.rules import NATS, Permissions
from bufgym.relay.store import StoredSession
from bufgym.relay.subscriber import Subscription, next_lane
from bufgym.robot.extra import needs
from bufgym.robot.tasks import Tasks

MESSAGE: Final = "bufgym.relay.message"
HOLD: Final = "bufgym.relay.hold"
STREAM: Final = "bufgym-relay"
ANSWER_S: Final = 3.0
"""Time for the server to take a message."""
TRIES: Final = 30
"""Times that a message is tried for which this relay has no room, once a second."""
ASK_S: Final = 5.0
"""Time after which the server is asked for messages again; it forgets who asked when it is restarted."""
_RETRY_S: Final = 1.0
_MAX_FRAME_BYTES: Final = 2**26


class Peers:
    """All other relays as one ``hub.Member``."""

    acks = False

    def __init__(self, hub: Hub, settings: Nats) -> None:
        with needs("nats", "mesh", "bufgym.relay"):
            import nats
        self._library: Any = nats
        self._hub, self._settings = hub, settings
        self.session: StoredSession = hub.store.open("nats", NATS, False, 0, 0)
        self.permissions = Permissions(hub.config.rules, NATS)
        self.subscriptions: dict[str, Subscription] = {}
        self.sent = 0
        self._awake = asyncio.Event()
        self._tasks = Tasks()
        self._nats: Any = None

    async def start(self) -> None:
        """Connect, and begin to share; the connection is made again whenever it breaks."""
        policy = await asyncio.to_thread(policies.warm, self._hub.config.policies[0])
        self.subscriptions = {"all": Subscription("all", pattern(""), policy, DEFAULT_CAPACITY)}
        where = self._settings
        options: dict[str, Any] = {"user_credentials": where.credentials} if where.credentials else {}
        try:
            if where.url.startswith("tls:"):
                options["tls"] = ssl.create_default_context(cafile=where.authority or None)
            async with asyncio.timeout(ANSWER_S):
                self._nats = await self._library.connect(
                    where.url, name=where.name, no_echo=True, max_reconnect_attempts=-1, error_cb=self._note, **options
                )
            await self._nats.subscribe(MESSAGE, cb=self._heard)
            self._stream = self._nats.jetstream(timeout=ANSWER_S)
            self._commands = await self._subscribed()
        except (OSError, TimeoutError, self._library.errors.Error) as error:
            await self.close()
            raise BufgymError(f"nats: {where.url}: {error or type(error).__name__}") from None
        self._hub.join(self)
        self._tasks.begin(self._send_all())
        self._tasks.begin(self._take_all())

    async def _subscribed(self) -> Any:
        """Make the stream of no_drop messages unless another relay has, and this relay's place in it."""
        from nats.js import api, errors

        limits = self._hub.config.store
        try:
            await self._stream.stream_info(STREAM)
        except errors.NotFoundError:
            await self._stream.add_stream(
                name=STREAM,
                subjects=[HOLD],
                retention=api.RetentionPolicy.INTEREST,
                discard=api.DiscardPolicy.NEW,
                max_age=limits.keep_s,
                max_bytes=limits.bytes,
            )
        in_order = api.ConsumerConfig(max_ack_pending=1, max_deliver=TRIES, deliver_policy=api.DeliverPolicy.NEW)
        return await self._stream.pull_subscribe(HOLD, durable=self._settings.name, stream=STREAM, config=in_order)

    async def close(self) -> None:
        """Leave the others."""
        await self._tasks.end()
        self._hub.leave(self)
        if self._nats is not None:
            await self._nats.close()

    async def _note(self, error: Exception) -> None:
        self._hub.audit.repeated(what="nats", code="wrong", why=f"{type(error).__name__}: {error}")

    def _goes(self, verb: Any, topic: str) -> bool:
        return not topic.startswith(f"/{OWN}/") and self.permissions.allow(verb, topic)

    def offer(self, subscription: Subscription, frame: Outgoing) -> None:
        """Offer a message of this relay."""
        if not frame.message.no_drop and self._goes("receive", frame.message.topic):
            subscription.offer(frame.message.topic, frame, frame.size_bytes)
            self._awake.set()

    async def _send_all(self) -> None:
        """Send one message after the other, so that little waits outside the queue."""
        while True:
            await self._awake.wait()
            self._awake.clear()
            while (lane := next_lane(list(self.subscriptions.values()), self._hub.clock())) is not None:
                item = lane.take(self._hub.clock())
                try:
                    if item is not None and self._nats.is_connected:  # else it is lost, as on any broken link
                        await self._nats.publish(MESSAGE, item.message.binary)
                        await self._nats.flush(ANSWER_S)
                        self.sent += 1
                except (TimeoutError, self._library.errors.Error) as error:
                    await self._note(error)
                lane.gone()

    async def _heard(self, heard: Any) -> None:
        message = await self._read(heard)
        if message is not None and not self._hub.is_no_drop(message.topic):
            self._hub.publish(self, message._replace(no_drop=False))

    async def _read(self, heard: Any) -> wire.Message | None:
        """Decode a message of another relay; None if it is none, or may not come in."""
        try:
            message = wire.decode(heard.data, _MAX_FRAME_BYTES)
            protocol.check_json(message)
        except BufgymError as error:
            await self._note(error)
            return None
        return message if self._goes("send", message.topic) else None

    async def hold(self, sender: StoredSession, message: wire.Message) -> bool | None:
        """Give a no_drop message to the other relays; return whether they may have it, None if NATS does not answer."""
        if not self._goes("receive", message.topic):
            return False
        frame = wire.encode(message)
        origin = f"{self._settings.name}\n{sender.identity.key}\n{sender.name}\n".encode()
        id = hashlib.blake2b(origin + frame, digest_size=16).hexdigest()  # the same when it is sent again
        try:
            await self._stream.publish(HOLD, frame, headers={"Nats-Msg-Id": id, "Relay": self._settings.name})
        except (TimeoutError, self._library.errors.Error) as error:
            await self._note(error)
            return None
        return True

    async def _take_all(self) -> None:
        while True:
            try:
                for heard in await self._commands.fetch(1, timeout=ASK_S):
                    await self._take(heard)
            except TimeoutError:
                pass  # there was none
            except self._library.errors.Error as error:
                await self._note(error)
                await asyncio.sleep(_RETRY_S)

    async def _take(self, heard: Any) -> None:
        """Hold a no_drop message of another relay for the receivers here; if there is no room, try again later."""
        headers = heard.headers or {}
        id, relay = headers.get("Nats-Msg-Id", ""), headers.get("Relay", "")
        if not (id and relay):
            await self._note(wire.WireError(f"{HOLD}: a message without the headers Nats-Msg-Id and Relay"))
            await heard.term()
            return
        number = int(hashlib.blake2b(id.encode(errors="replace"), digest_size=6).hexdigest(), 16)
        message = None if relay == self._settings.name else await self._read(heard)
        if message is not None and self._hub.is_no_drop(message.topic) and number != self.session.received:
            try:
                self._hub.hold(self, message, taken=number)
            except wire.RefusedError as refused:
                if refused.code != "no_receiver":
                    await self._note(refused)
                    await heard.nak(delay=_RETRY_S)
                    return
        await heard.ack()

    def _ignore(self, *words: Any, **fields: Any) -> None:
        """Do nothing: the others are told nothing, no message is held for them, and they end with the relay."""

    wake = tell = end = _ignore

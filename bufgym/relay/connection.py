"""One client's connection: its identity and its checked requests. Its ``outbox`` sends to it."""

import asyncio
import json
import re
import secrets
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import WebSocketException

from bufgym.ground.errors import BufgymError
from bufgym.model.checks import whole
from bufgym.relay import policies, replay, wire
from bufgym.relay.config import DEFAULT_CAPACITY
from bufgym.relay.hub import MAX_JSON_BYTES, OWN, Hub, Outgoing
from bufgym.relay.identity import Verifier, certificate_email
from bufgym.relay.outbox import Outbox
from bufgym.relay.patterns import pattern
from bufgym.relay.quota import Quota
from bufgym.relay.recorder import FOLDER as RECORDINGS
from bufgym.relay.rules import Identity, Permissions, plain_address
from bufgym.relay.store import Mailbox
from bufgym.relay.subscriber import Subscription
from bufgym.relay.wire import RefusedError, WireError

HELLO_BYTES: Final = 2**16
"""Size limit of a frame from a client that has not yet said hello."""
MAX_PRIORITY: Final = 1e6
MAX_CAPACITY: Final = 1_000
"""Largest L of a subscriber's queue."""
_SESSION: Final = re.compile(r"[\w.-]{1,64}", re.ASCII)
_POLICY_VIOLATION: Final = 1008
_ORDERS: Final = ("subscribe", "unsubscribe", "publish", "ack", "recordings", "replay")


class Connection:
    """A ``hub.Member`` on a WebSocket."""

    session: Mailbox
    permissions: Permissions
    name: str  # sender's name as others see it
    acks = True

    def __init__(self, hub: Hub, socket: ServerConnection, verifier: Verifier | None) -> None:
        self._hub = hub
        self._socket = socket
        self._verifier = verifier
        self._outbox = Outbox(hub, socket)
        self._ending: asyncio.Task[None] | None = None
        self.subscriptions: dict[str, Subscription] = {}
        self.identity = Identity(plain_address(socket.remote_address[0]))

    async def serve(self, greeted: Callable[[], None]) -> None:
        """Serve the client from hello to the end; call ``greeted`` after the hello."""
        try:
            async with asyncio.timeout(self._hub.config.limits.hello_s):
                await self._hello()
        except (BufgymError, TimeoutError) as error:
            await self._refuse_and_close("hello", error)
            return
        except WebSocketException:
            return
        greeted()
        writer = asyncio.create_task(self._outbox.run())
        expiry = asyncio.get_running_loop().call_later(
            min(self.identity.until_s - time.time(), 2**20), lambda: self.end("the token has expired")
        )
        fault = None
        try:
            await self._read()
        except WireError as error:
            fault = error
        except WebSocketException:
            pass
        finally:
            expiry.cancel()
            writer.cancel()
            self._hub.leave(self)
            self._quota.subscriptions -= len(self.subscriptions)
            self._hub.quotas.left(self._quota)
            self._hub.audit("left", session=self.session.name, **self.identity.as_json())
        if fault is not None:
            await self._refuse_and_close("frame", fault)
        elif self._ending is not None:
            await self._ending  # with its reason, which the end of this would not say

    async def _hello(self) -> None:
        data = await self._socket.recv()
        said = wire.heard(data) if isinstance(data, str) else {"op": "a binary frame"}
        if said["op"] != "hello":
            raise WireError(f"{said['op']}: must be hello first")
        if said["version"] != wire.VERSION or said.get("form", "binary") not in wire.FORMS:
            raise WireError(f"hello: must be of version {wire.VERSION}, of form {' or '.join(wire.FORMS)}")
        self.identity = await self._identified(said.get("token"))
        self._admit(said, said.get("form", "binary"))
        self._welcome()

    def _admit(self, said: Mapping[str, Any], form: str) -> None:
        """Let it in, in a session of its own."""
        self.permissions = Permissions(self._hub.config.rules, self.identity)
        if not self.permissions.rules:
            raise RefusedError("unauthorized", "no rule allows anything to this identity")
        temporary = "session" not in said
        name = said.get("session", secrets.token_hex(8))
        if not _SESSION.fullmatch(name):
            raise WireError(f"hello: session = {name!r}: must be 1 to 64 letters, digits, '-', '_', '.'")
        self.name = said.get("name", self.identity.key)
        wire.check_name("hello: name", self.name)
        if not self.name or self.name == OWN:
            raise WireError(f"hello: name = {self.name!r}: must be a name, not the relay's")
        quota = self._hub.quotas.of(self.identity.key)
        quota.connect()
        try:
            store, received = self._hub.store, int(said.get("received", 0))
            self.session = store.open(name, self.identity, temporary, received, int(said.get("acked", 0)))
        except BaseException:
            self._hub.quotas.left(quota)
            raise
        self._quota: Quota = quota
        self._outbox.begin(self, form, received)
        self._hub.settled(store.acked(self.session, received))
        self._hub.join(self)
        self._socket.protocol.max_message_size = self._hub.config.limits.message_bytes
        self._hub.audit("joined", name=self.name, session=name, **self.identity.as_json())

    async def _identified(self, token: str | None) -> Identity:
        """Who it is: by token, certificate, or address alone."""
        tls = self._socket.transport.get_extra_info("ssl_object")
        email, until_s = certificate_email(tls.getpeercert()) if tls is not None else "", float("inf")
        if token is not None:
            if self._verifier is None:
                raise RefusedError("unauthorized", "token: this relay takes none")
            email, until_s = await self._verifier.email(token)
        return Identity(self.identity.address, email, until_s=until_s)

    def _welcome(self) -> None:
        config = self._hub.config
        self.tell(
            "welcome",
            version=wire.VERSION,
            name=self.name,
            session=self.session.name,
            identity=self.identity.as_json(),
            received=self.session.received,
            no_drop=config.no_drop,
            window=config.store.window,
            max_message_bytes=config.limits.message_bytes,
            policies=config.policies,
            default_policy=config.policies[0],
            default_capacity=DEFAULT_CAPACITY,
            rules=[
                {"send": rule.send, "receive": rule.receive, "topic": rule.topic} for rule in self.permissions.rules
            ],
        )

    async def _read(self) -> None:
        """What the client says, until one of both ends it."""
        while self._ending is None:
            data = await self._socket.recv()
            if isinstance(data, bytes):
                await self._answer(wire.decode(data, self._hub.config.limits.message_bytes))
            elif len(data) > MAX_JSON_BYTES:
                raise WireError(f"text of {len(data)} characters: must be at most {MAX_JSON_BYTES}")
            else:
                said = wire.heard(data)
                match said["op"]:
                    case "publish":
                        await self._answer(wire.from_json(said))
                    case "subscribe":
                        await self._subscribe(said)
                    case "unsubscribe":
                        if self._hub.unsubscribe(self, said["id"]):
                            self._quota.subscriptions -= 1
                    case "ack":
                        self._ack(said["seq"])
                    case "recordings":
                        self.tell("recordings", files=await asyncio.to_thread(replay.recordings, self._recordings))
                    case "replay":
                        await self._replay(said)
                    case op:
                        raise WireError(f"{op}: must be one of {', '.join(_ORDERS)}")

    @property
    def _recordings(self) -> Path | None:
        folder = self._hub.config.folder
        return None if folder is None else folder / RECORDINGS

    async def _replay(self, said: Mapping[str, Any]) -> None:
        def may(topic: str) -> bool:
            return self.permissions.allow("receive", topic)

        asked = said["file"], said["from_us"], said["most_bytes"]
        try:
            part = await asyncio.to_thread(replay.piece, self._recordings, *asked, may)
        except BufgymError as error:
            self._refuse("replay", error, id=said["id"])
        else:
            self.tell("replayed", id=said["id"], **part)

    async def _answer(self, message: wire.Message) -> None:
        """Publish it, or say why not: of a no_drop message every time, of others now and then."""
        try:
            await self._publish(message)
        except RefusedError as refused:
            first = self._hub.audit.repeated(
                what="publish",
                code=refused.code,
                topic=message.topic,
                session=self.session.name,
                address=self.identity.address,
                email=self.identity.email,
            )
            if message.no_drop or first:
                self._refuse("publish", refused, topic=message.topic, seq=message.seq)

    async def _publish(self, message: wire.Message) -> None:
        hub, topic = self._hub, message.topic
        again = message.no_drop and 0 < message.seq <= self.session.received
        if not again:
            self._quota.message(len(message.payload), hub.clock())
            if topic.startswith(f"/{OWN}/") or not self.permissions.allow("send", topic):
                raise RefusedError("unauthorized", f"topic {topic}: no rule allows to send there")
            self._quota.topic(topic)
            if message.no_drop != hub.is_no_drop(topic):
                raise RefusedError("wrong", f"topic {topic}: is {'' if hub.is_no_drop(topic) else 'not '}no_drop here")
            if message.encoding == "json":
                _check_json(message)
        message = message._replace(sender=self.name, stamp_us=message.stamp_us or time.time_ns() // 1000)
        if not message.no_drop:
            hub.publish(self, message)
            return
        if not again:
            if message.seq != self.session.received + 1:
                raise RefusedError("out_of_order", f"seq = {message.seq}: must be {self.session.received + 1}")
            shared = False if hub.peers is None else await hub.peers.hold(self.session, message)
            if shared is None:
                self.end("NATS does not answer")  # the client connects again, and sends this again
                return
            if message.seq > self.session.received:  # else it was taken meanwhile, over another connection
                hub.hold(self, message, shared=shared)
        self.tell("ack", seq=message.seq)

    async def _subscribe(self, said: Mapping[str, Any]) -> None:
        try:
            self._quota.message(0, self._hub.clock())
            if said["id"] not in self.subscriptions:
                self._quota.subscribe()
            try:
                subscription = await self._subscription(said)
            except BaseException:
                if said["id"] not in self.subscriptions:
                    self._quota.subscriptions -= 1
                raise
        except BufgymError as error:
            self._refuse("subscribe", error, id=said["id"])
            return
        self._hub.subscribe(self, subscription)
        self.tell("subscribed", id=subscription.id, policy=subscription.policy.name, capacity=subscription.capacity)

    async def _subscription(self, said: Mapping[str, Any]) -> Subscription:
        config = self._hub.config
        name, capacity = said.get("policy", config.policies[0]), said.get("capacity", DEFAULT_CAPACITY)
        if name not in config.policies:
            raise RefusedError("wrong", f"policy {name!r}: must be one of {', '.join(config.policies)}")
        whole("capacity", capacity, 1, MAX_CAPACITY)
        priority = float(said.get("priority", 1.0))
        if not 0 <= priority <= MAX_PRIORITY:
            raise RefusedError("wrong", f"priority = {priority}: must be from 0 to {MAX_PRIORITY:g}")
        if said.get("durable", False) and self.session.temporary:
            raise RefusedError("wrong", "durable: needs a session of a name")
        wire.check_name("id", said["id"])
        return Subscription(
            said["id"],
            pattern(said["topic"]),
            # A policy that nobody has asked for yet is compiled, while others are served.
            await asyncio.to_thread(policies.warm, name),
            capacity,
            priority=priority,
            durable=said.get("durable", False),
            left_bytes=self._socket.transport.get_write_buffer_size,
        )

    def _ack(self, number: int) -> None:
        self._outbox.acked(number)
        self._hub.settled(self._hub.store.acked(self.session, number))

    @property
    def sent(self) -> int:
        """Messages that have gone to it."""
        return self._outbox.sent

    def offer(self, subscription: Subscription, frame: Outgoing) -> None:
        """A message that its queues decide on."""
        subscription.offer(frame.message.topic, frame, frame.size_bytes)
        self._outbox.wake()

    def wake(self) -> None:
        """The store has something for it."""
        self._outbox.wake()

    def tell(self, op: str, **fields: Any) -> None:
        """Say this, before any message."""
        if not self._outbox.tell(op, **fields):
            self.end("reads none of the answers")

    def end(self, why: str) -> None:
        """Close it."""
        if self._ending is None:
            self._hub.audit("closed", why=why, session=self.session.name, **self.identity.as_json())
            self._ending = asyncio.create_task(self._socket.close(_POLICY_VIOLATION, why))

    def _refuse(self, what: str, error: BufgymError, **fields: Any) -> None:
        code = error.code if isinstance(error, RefusedError) else "wrong"
        if what != "publish":
            self._hub.audit("refused", what=what, code=code, why=str(error), **self.identity.as_json())
        self.tell("refused", what=what, code=code, why=str(error), **fields)

    async def _refuse_and_close(self, what: str, error: Exception) -> None:
        if isinstance(error, TimeoutError):
            error = RefusedError("wrong", f"no hello within {self._hub.config.limits.hello_s:g} s")
        assert isinstance(error, BufgymError)
        self._refuse(what, error)
        try:
            async with asyncio.timeout(1.0):
                await self._outbox.answers()
                await self._socket.close(_POLICY_VIOLATION, what)
        except (WebSocketException, TimeoutError):
            self._socket.transport.abort()


def _check_json(message: wire.Message) -> None:
    if len(message.payload) > MAX_JSON_BYTES:
        raise RefusedError("too_large", f"topic {message.topic}: JSON must be at most {MAX_JSON_BYTES} bytes")
    try:
        json.loads(bytes(message.payload), parse_constant=wire.no_constant)
    except (ValueError, RecursionError) as error:
        raise RefusedError("wrong", f"topic {message.topic}: payload must be JSON: {error}") from None

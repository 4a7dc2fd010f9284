"""One client's connection in its session: its checked requests. Its ``outbox`` sends to it."""

import asyncio
import itertools
import secrets
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import partial
from typing import Any, Final

from websockets.exceptions import WebSocketException

from bufgym.utils.errors import BufgymError
from bufgym_relay import outbox, policies, protocol, replay
from bufgym_relay.admission import POLICY_VIOLATION
from bufgym_relay.caller import Caller
from bufgym_relay.config import Rule
from bufgym_relay.drivers import check_speed
from bufgym_relay.outbox import Outbox
from bufgym_relay.outgoing import Outgoing
from bufgym_relay.protocol import Admitted
from bufgym_relay.quota import Quota
from bufgym_relay.recorder import FOLDER as RECORDINGS
from bufgym_relay.roster import is_last
from bufgym_relay.rules import Permissions
from bufgym_relay.stored import StoredSession, command_number
from bufgym_relay.subscriber import Subscription
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.orders import is_stop, order, robot_of
from bufgym_robot.wire.patterns import pattern

Work = Callable[[], Coroutine[Any, Any, None]]
HELLO_BYTES: Final = 2**16  # Size limit of a frame from a client that has not yet said hello
_MOST_IN_TURN: Final = 8  # frames of a client that are taken without a turn of all others
_MOST_ORDERS: Final = 64  # orders of a client that wait for the disk; beyond, nothing more of it is read
_RIGHT_BYTES: Final = 100  # bytes of JSON that a topic counts for whose rights are asked
BUSY_S: Final = 1.0  # Time to a refusal because too much waits for the disk, so that clients do not try at once


class Connection:
    """A ``hub.Member`` on a WebSocket, made once its client is let in."""

    acks = True
    own_policies: tuple[str, ...] = ()
    """Policies that its kind of client may choose beside the configuration's."""

    def __init__(self, caller: Caller, admitted: Admitted, session: StoredSession, quota: Quota) -> None:
        self._caller, self._admitted, self._quota = caller, admitted, quota
        self._hub, self._socket = caller.hub, caller.socket
        self.session, self.permissions, self.subscriptions = session, admitted.permissions, caller.subscriptions
        self._outbox = Outbox(caller, self, admitted.form, admitted.received)
        self._recordings = None if self._hub.config.folder is None else self._hub.config.folder / RECORDINGS
        self.wake, self.tell, self.sent = self._outbox.wake, caller.tell, 0
        caller.on_answer = self._answer_waits
        # ``end`` is called where nobody may wait, so a task closes the socket; the first reason stands.
        self._ending: asyncio.Task[None] | None = None
        self._orders: asyncio.Queue[tuple[int, Work]] = asyncio.Queue(_MOST_ORDERS)
        self._ids_waiting: list[str] = []  # of subscriptions

    @staticmethod
    async def greet(caller: Caller) -> Admitted:
        """Take the client's hello."""
        said = protocol.hello(await caller.heard())
        identity = await caller.prove(said.get("token"))
        return protocol.admit(said, identity, caller.hub.config.rules, secrets.token_hex(8))

    async def run(self, greeted: Callable[[], None]) -> None:
        """Serve the client to the end; call ``greeted`` after its welcome."""
        hub, caller, admitted = self._hub, self._caller, self._admitted
        hub.store.acked(self.session, admitted.received)
        hub.join(self)
        self._socket.protocol.max_message_size = hub.config.limits.message_bytes
        hub.audit("joined", name=admitted.name, session=self.session.name, **caller.identity.as_json())
        # Told before the outbox runs, so that nothing overtakes the welcome.
        numbers = self.session.received, hub.now_us()
        self.tell("welcome", **protocol.welcome(hub.config, admitted, caller.identity, *numbers))
        greeted()
        hub.holding.begin(self._tell_outcomes(admitted.open))
        works = self._outbox.run, self._carry_out
        tasks = [asyncio.create_task(hub.turns.of(caller.identity.key, work)) for work in works]
        left_s = min(caller.identity.until_s - time.time(), 2**20)
        expiry = asyncio.get_running_loop().call_later(left_s, self.end, "the token has expired")
        try:
            await self._read()
        except WebSocketException:
            pass
        finally:
            expiry.cancel()
            # The tasks first: nothing may begin for a session that has left the hub.
            for task in tasks:
                task.cancel()
            while not self._orders.empty():
                self._release(self._orders.get_nowait()[0])
            hub.leave(self)
            hub.audit("left", session=self.session.name, **caller.identity.as_json())
        if self._ending is not None:
            await self._ending  # with its reason, which the end of this would not say

    async def _tell_outcomes(self, seqs: Sequence[int]) -> None:
        """Tell the outcomes of the client's messages of which it has not heard."""
        for seq in seqs:
            if (known := self.session.outcomes.get(seq)) is not None:
                self._hub.tell_outcome(known)
            elif seq <= self.session.received and not await self._hub.store.waits(self.session, seq):
                self.tell("delivered", seq=seq, receivers=1, lost=1, why=wire.UNKNOWN)

    async def _read(self) -> None:
        """What the client says, until one of both ends it."""
        for heard in itertools.count(1):
            # The reason is on its way: what the client still says is not obeyed.
            if self._ending is not None:
                break
            self.session.heard_s = self._hub.clock()
            # A socket with much to read never lets go of the event loop by itself.
            if heard % _MOST_IN_TURN == 0:
                await asyncio.sleep(0)
            match protocol.asked(await self._caller.heard(), self._hub.config.limits.message_bytes):
                case wire.Message() as message:
                    message = message._replace(at_us=self._hub.now_us())  # what waits for the disk grows old, too
                    if message.encoding == "json":
                        await self._caller.pace(len(message.payload))
                    if message.no_drop:
                        await self._later(partial(self._publish, message), message)
                    else:
                        await self._publish(message)
                case {"op": "subscribe" | "unsubscribe"} as said:
                    # A change of an id must not overtake an earlier one of it that waits for the disk.
                    late = said.get("durable") or said["id"] in self._ids_waiting
                    self._ids_waiting.append(said["id"])
                    change = partial(self._change, said)
                    await (self._later(change) if late else change())
                case {"op": "ack", "seq": number} as said:
                    self._outbox.acked(number)
                    self._hub.store.acked(self.session, number, said.get("why", "")[: protocol.MOST_WHY])
                case {"op": "may", "topics": topics}:
                    await self._caller.pace(_RIGHT_BYTES * len(topics))
                    self.tell("rights", rights={topic: self._right(topic) for topic in topics})
                case {"op": "clock"}:
                    self.tell("clock", clock_us=self._hub.now_us())
                case {"op": "recordings"}:
                    folder = self._recordings if self.permissions.receives else None
                    self.tell("recordings", files=await asyncio.to_thread(replay.recordings, folder))
                case said:
                    await self._replay(said)

    def _right(self, topic: str) -> dict[str, Any]:
        """What the client may do on a topic, so that it need match no rule itself."""
        if not wire.is_name(topic):
            return {"send": False}
        send = not topic.startswith(f"/{wire.OWN}/") and self.permissions.allow("send", topic)
        kinds = {"no_drop": self._hub.is_no_drop(topic), "latched": self._hub.is_latched(topic)}
        return {"send": send, "command_s": self.permissions.command_s(topic), **kinds}

    async def _later(self, work: Work, message: wire.Message | None = None) -> None:
        """Have this done after all else that waits for the disk, while the client is read on."""
        size_bytes = 0 if message is None else len(message.payload)
        if message is not None and not self._hub.store.reserve(size_bytes):
            size_bytes, work = 0, partial(self._busy, message.topic, message.seq)
        if message is not None:  # the client sends it again on its next connection, and must find the session there
            self.session.kept = True
        # Counted before it waits: a session with orders is not forgotten.
        self.session.orders += 1
        await self._orders.put((size_bytes, work))

    def _release(self, size_bytes: int) -> None:
        self.session.orders -= 1
        self._hub.store.release(size_bytes)

    async def _carry_out(self) -> None:
        """Carry out the orders that wait for the disk; one that has begun is done though the connection ends."""
        try:
            while True:
                await asyncio.shield(self._hub.holding.begin(self._one(*await self._orders.get())))
        except Exception:
            self._socket.transport.abort()
            raise

    async def _one(self, size_bytes: int, work: Work) -> None:
        try:
            if self._ending is None:  # else its client says it again
                await self._hub.turns.of(self._caller.identity.key, work)
        finally:
            self._release(size_bytes)

    async def _busy(self, topic: str, seq: int) -> None:
        await asyncio.sleep(BUSY_S)  # so that its client does not hurry
        self._refused(wire.RefusedError("busy", "too much waits for the disk"), topic, seq, no_drop=True)

    async def _change(self, said: Mapping[str, Any]) -> None:
        try:
            if said["op"] == "subscribe":
                await self._subscribe(said)
            else:
                self._hub.unsubscribe(self, said["id"])
        finally:
            self._ids_waiting.remove(said["id"])

    async def _replay(self, said: Mapping[str, Any]) -> None:
        may = partial(self.permissions.allow, "receive")
        asked = said["file"], said["from_us"], said["most_bytes"]
        await self._caller.pace(min(said["most_bytes"], replay.MOST_BYTES))
        try:
            async with self._hub.replaying:
                text = await asyncio.to_thread(replay.answer_text, said["id"], self._recordings, *asked, may)
        except BufgymError as error:
            self._caller.refuse("replay", error, id=said["id"])
        else:
            self._caller.say(text)

    async def _publish(self, message: wire.Message) -> None:
        """Publish it, or say why not: of a no_drop message every time, of others now and then."""
        hub = self._hub
        try:
            who, no_drop, now_s = self._caller.identity, hub.is_no_drop(message.topic), hub.clock()
            new = protocol.check(message, self.session, self.permissions, self._quota, no_drop, now_s)
            check_speed(message, self.permissions.speed(message.topic))
            hub.drivers.note(message.topic, self.session.name, address=who.address, email=who.email)
            if is_last(message.topic):
                hub.audit("removed", topic=message.topic, session=self.session.name, **who.as_json())
            at_us = message.at_us or hub.now_us()
            message = message._replace(sender=self._admitted.name, stamp_us=message.stamp_us or at_us, at_us=at_us)
            number = command_number(self.session, message.seq) if message.no_drop and robot_of(message.topic) else 0
            message = message._replace(number=number, seen="")
            message = hub.orders.dated(message, self.permissions.command_s(message.topic), hub.now_us())
            if is_stop(message.topic):
                hub.holding.begin(self._confirm(message, hub.desk.order(message, self._shown, who)))
            elif not message.no_drop:
                hub.publish(self, message)
            elif not new or await self._hold(message):
                self.tell("ack", seq=message.seq)
        except wire.RefusedError as refused:
            self._refused(refused, message.topic, message.seq, message.no_drop)

    @property
    def _shown(self) -> str:
        """Who says a stop, as others see it; a name that reads as an e-mail but is not proved says so."""
        name = self._admitted.name
        return self._caller.identity.email or (f"{name} (not proved)" if "@" in name else name)

    async def _confirm(self, message: wire.Message, kept: asyncio.Future[None]) -> None:
        """Confirm a stop or a release once it is on the disk; until then its client says it again."""
        try:
            await kept
        except wire.RefusedError as refused:
            why = f"it is in force, but lost when the relay restarts: {refused}"
            self._refused(wire.RefusedError(refused.code, why), message.topic, message.seq, no_drop=False)
        else:
            self.tell("stopped", topic=message.topic, id=order(message)["id"])

    def _refused(self, refused: wire.RefusedError, topic: str, seq: int, no_drop: bool) -> None:
        refused = self.session.doubted(refused, seq if no_drop else -1)
        about = {"code": refused.code, "topic": topic, "session": self.session.name}
        first = self._hub.audit.repeated(what="publish", **about, **self._caller.identity.as_json())
        if no_drop or first or refused.code in ("too_late", "stopped") or is_stop(topic):
            self._caller.refuse("publish", refused, topic=topic, seq=seq)

    async def _hold(self, message: wire.Message) -> bool:
        """Hold a no_drop message; return whether it is held."""
        shared: bool | None = False
        if self._hub.peers is not None:
            await self._hub.make_room(self, message)  # what is refused here, the others must not have
            shared = await self._hub.peers.hold(self.session, message)
        if shared is None:
            self.end("NATS does not answer")  # the client connects again, and sends this again
            return False
        if message.seq > self.session.received:  # else it was taken meanwhile, over another connection
            await self._hub.hold(self, message, shared=shared)
        return True

    async def _subscribe(self, said: Mapping[str, Any]) -> None:
        config, left_bytes = self._hub.config, self._socket.transport.get_write_buffer_size
        name = said.get("policy", config.policies[0])
        try:
            self._quota.message(0, self._hub.clock())
            self.permissions.check_subscription(said["topic"])
            # A policy that nobody has asked for yet is compiled, while others are served.
            policy = (
                await asyncio.to_thread(policies.warm, name) if name in (*config.policies, *self.own_policies) else None
            )
            self._quota.subscribe(said["id"], self.subscriptions, pattern(said["topic"]).cost)
            subscription = protocol.subscription(said, config, policy, self.session.temporary, left_bytes)
            who = self._caller.identity
            subscription.may_grow = partial(self._hub.quotas.may_have_queue, who.key, who.address)
            await self._hub.subscribe(self, subscription)
        except BufgymError as error:
            self._caller.refuse("subscribe", error, id=said["id"])
            return
        self.tell("subscribed", id=subscription.id, policy=subscription.policy.name, capacity=subscription.capacity)
        await self._hub.offer_latched(self, subscription)

    def offer(self, subscription: Subscription, outgoing: Outgoing) -> None:
        """A message that its queues decide on."""
        if is_stop(outgoing.message.topic):
            self._outbox.urgent[outgoing.message.topic] = outgoing
            self._outbox.wake()
        else:
            subscription.offer(outgoing.message.topic, outgoing, outgoing.size_bytes)
            self._outbox.offered(outgoing.size_bytes)

    def _answer_waits(self) -> None:
        self._outbox.wake()
        if len(self._caller.answers) > outbox.MAX_ANSWERS:
            self.end("reads none of the answers")

    def reruled(self, rules: Sequence[Rule]) -> None:
        """Take new rules; end the connection if none is for it."""
        self.permissions = Permissions(rules, self._caller.identity)
        if not self.permissions.rules:
            self.end("no rule allows anything to this identity any more")

    def end(self, why: str) -> None:
        """Close it."""
        if self._ending is None:
            self._hub.audit("closed", why=why, session=self.session.name, **self._caller.identity.as_json())
            self._ending = asyncio.create_task(self._socket.close(POLICY_VIOLATION, why))


async def serve(kind: type[Connection], caller: Caller, greeted: Callable[[], None]) -> None:
    """Serve a client from its hello to the end; call ``greeted`` after the hello."""
    hub, stage, hello_s = caller.hub, "hello", caller.hub.config.limits.hello_s
    try:
        try:
            async with asyncio.timeout(hello_s):
                admitted = await kind.greet(caller)
        except TimeoutError:
            raise wire.RefusedError("too_slow", f"no hello within {hello_s:g} s") from None
        await hub.store.catch_up(caller.identity, admitted.session, admitted.acked, admitted.received)
        if admitted.robot:
            about = caller.identity, admitted.session, admitted.permissions
            if (other := hub.claims.rival(admitted.robot, *about)) is not None:
                hub.take_over(*other.key)
                hub.store.forget(other)  # what waits for it is lost, as its senders are told
        hub.take_over(caller.identity.key, admitted.session)
        await hub.store.orders_done(caller.identity, admitted.session)
        hub.take_over(caller.identity.key, admitted.session)  # before it counts: the old connection may be long dead
        with hub.quotas.connection(caller.identity.key, caller.subscriptions, caller.identity.address) as quota:
            # Nothing is awaited from ``take_over`` to here, or a second connection of the session could come between.
            numbers = admitted.received, admitted.acked
            session = hub.store.open(admitted.session, caller.identity, admitted.temporary, *numbers)
            session.greeted(admitted.open, admitted.whys, hub.clock())
            if admitted.robot:
                hub.claims.claim(admitted.robot, session)
            stage = "frame"
            one = kind(caller, admitted, session, quota)
            await hub.turns.of(caller.identity.key, partial(one.run, greeted))
    except BufgymError as error:
        caller.refuse(stage, error)
        await caller.close(stage)
    except WebSocketException:
        pass

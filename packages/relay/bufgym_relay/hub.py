"""Members of a relay and the routing between them, without sockets."""

from __future__ import annotations

import asyncio
import functools
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from bufgym_relay.audit import Audit
from bufgym_relay.claims import Claims
from bufgym_relay.config import Config
from bufgym_relay.desk import Desk
from bufgym_relay.disk import Disk
from bufgym_relay.drivers import Drivers
from bufgym_relay.held import MOST
from bufgym_relay.last import Last
from bufgym_relay.member import Member, OtherRelays
from bufgym_relay.orders import Orders
from bufgym_relay.outgoing import Outgoing
from bufgym_relay.quota import Quotas
from bufgym_relay.recorder import Recorder, Tape
from bufgym_relay.roster import GONE, Roster, is_last, status_of
from bufgym_relay.rules import NATS, Permissions
from bufgym_relay.store import Store
from bufgym_relay.stored import Settled, StoredSession
from bufgym_relay.subscriber import Subscription
from bufgym_relay.turns import Turns
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.clock import ServerClock
from bufgym_robot.wire.messages import RefusedError
from bufgym_robot.wire.orders import heard_stops, robot_of
from bufgym_robot.wire.patterns import escaped, pattern
from bufgym_robot.wire.tasks import Tasks

if TYPE_CHECKING:
    from bufgym_relay.foxglove import Window

STATUS: Final = f"/{wire.OWN}/status"
CONNECTED: Final = "connected"  # State of the connection to the other relays
MAX_ROUTES: Final = 10_000
MOST_IN_TURN: Final = 256  # Latched topics that are offered in a turn of the event loop
MAX_STATUS_BYTES: Final = 2**16  # of a status, beyond which no stops are looked for in it


class Hub:
    """State shared by the connections."""

    def __init__(self, config: Config, clock: Callable[[], float] = time.monotonic) -> None:
        self.config = config
        self.clock = clock
        self.now_us = ServerClock(clock).now_us
        self.orders = Orders()
        if config.folder is not None:
            config.folder.mkdir(parents=True, exist_ok=True)
        self.audit = Audit(config.folder, config.audit)
        self.quotas = Quotas(config.limits, clock)
        self.members: dict[StoredSession, Member] = {}
        self.store = Store(config, self.audit, self.settled, clock)
        disk = Disk("recordings", self.audit)
        recorder = Recorder.of(config, disk)
        self.tape = None if recorder is None else Tape(recorder, disk)
        self.disks = [one for one in (self.store.disk, disk, self.audit.disk) if one is not None]
        self.holding = Tasks()  # orders that wait for the disk, also of connections that have ended
        self.drivers = Drivers(self.audit, clock)
        self.claims = Claims(self.store, self.audit, lambda message: self.publish(None, message), clock, self.now_us)
        self.orders.is_here = lambda robot: self.claims.get(robot) is not None
        self.roster = Roster(self.store, lambda message: self.publish(None, message), clock, self.now_us)
        self.own: list[Tape | Window | Roster] = [self.roster, *([] if self.tape is None else [self.tape])]
        self.making = asyncio.Lock()  # whose turn it is to make a queue
        self.writing = asyncio.Lock()  # whose turn it is to write a large message
        self.replaying = asyncio.Lock()  # whose turn it is to read a recording
        self.turns = Turns()
        self._failed: set[str] = set()
        self.received = 0
        self._sent = 0
        self._dropped = 0
        self._routes: dict[str, list[tuple[Member, Subscription]]] = {}
        self._last = Last(self.audit)
        self.peers: OtherRelays | None = None  # the other relays, if it shares topics with any
        self.desk = Desk(self.orders, self.store, self.audit, self.now_us, self._send, self.holding)
        for message in self.roster.away():
            self._last.keep(Outgoing(message), "")

    def take_over(self, identity: str, name: str) -> None:
        """End the connection of this session, if it has one, and free its place for the next."""
        session = self.store.sessions.get((identity, name))
        if session in self.members:
            other = self.members[session]
            self._detach(other)
            self.quotas.of(identity).left(other.subscriptions)
            other.end("taken over by another connection")

    def join(self, member: Member) -> None:
        """Add a member that has said hello."""
        self.members[member.session] = member

    def reruled(self, config: Config) -> None:
        """Take another configuration's rules, for all that are here, too."""
        self.config = config
        for member in list(self.members.values()):
            member.reruled(config.rules)
        for part in self.own:
            if not isinstance(part, Roster):
                part.reruled(config.rules)
        self._routes.clear()

    def leave(self, member: Member) -> None:
        """Remove a member whose connection has ended."""
        if self.members.get(member.session) is member:
            self._detach(member)
            self.store.left(member.session)

    def _detach(self, member: Member) -> None:
        del self.members[member.session]
        self._sent += member.sent
        self._dropped += sum(each.dropped for each in member.subscriptions.values())
        self._routes.clear()

    async def subscribe(self, member: Member, subscription: Subscription) -> None:
        """Add a subscription; it replaces one with the same id.

        Raises RefusedError: it is durable, and there are too many or the store cannot be written.
        """
        if subscription.durable:
            await self.store.want(member.session, subscription.id, subscription.pattern)
        self.unsubscribe(member, subscription.id, still_held=subscription.durable)
        member.subscriptions[subscription.id] = subscription
        self._routes.clear()

    async def offer_latched(self, member: Member, subscription: Subscription) -> None:
        """Offer a new subscription what is latched; all others have a turn after some of it."""
        last = [*self.desk.said.items(), *self._last.items()]
        for k, (topic, frame) in enumerate(last):
            if k % MOST_IN_TURN == 0:
                await asyncio.sleep(0)
                if member.subscriptions.get(subscription.id) is not subscription:
                    break
            # Otherwise it has got a newer one meanwhile.
            newest = frame in (self.desk.said.get(topic), self._last.get(topic))
            if newest and subscription.pattern.part(topic) and member.permissions.allow("receive", topic):
                member.offer(subscription, frame)

    def unsubscribe(self, member: Member, id: str, *, still_held: bool = False) -> None:
        """Remove a subscription if there is one of this id; its messages may be held all the same."""
        if not still_held:
            self.store.want_no_more(member.session, id)
        old = member.subscriptions.pop(id, None)
        if old is not None:
            self._dropped += old.dropped
            self._routes.clear()

    def is_no_drop(self, topic: str) -> bool:
        """Whether the topic is lossless."""
        return _any_whole(self.config.no_drop, topic)

    def is_latched(self, topic: str) -> bool:
        """Whether the topic's last message is kept by the configuration."""
        return _any_whole(self.config.latched, topic)

    def publish(self, sender: Member | None, message: wire.Message) -> None:
        """Offer a message to each subscriber's queue except its sender's."""
        self._show(message)
        outgoing = Outgoing(message)
        if is_last(message.topic) and message.payload == GONE:
            self._last.forget(message.topic)
        elif is_last(message.topic) or self.is_latched(message.topic):
            self._last.keep(outgoing, "" if sender is None else sender.session.identity.key)
        robot = status_of(message.topic)
        # Only the robot itself knows its stops, and the relay where it is.
        if sender is not None and robot and (sender.session.identity == NATS or sender.session.robot == robot):
            if b'"stops"' in bytes(message.payload[:MAX_STATUS_BYTES]):
                self.desk.take(robot, heard_stops(message), sender, sender.session.identity.key)
        self._send(sender, outgoing)

    def _send(self, sender: Member | None, outgoing: Outgoing) -> None:
        """Offer it to each subscriber but its sender."""
        message = outgoing.message
        for member, subscription in self._route(message.topic):
            if member is not sender:
                member.offer(subscription, outgoing)

    def _show(self, message: wire.Message) -> None:
        """Count a message, and show it to the relay's own parts."""
        self.received += 1
        for each in self.own:
            with self.outliving(type(each).__name__):
                each(message)

    @contextmanager
    def outliving(self, part: str) -> Iterator[None]:
        """Run a ``part`` of the relay whose faults end nothing else; the first of each kind is logged."""
        try:
            yield
        except Exception as error:
            fault = f"{part}: {type(error).__name__}"
            if fault not in self._failed:
                self._failed.add(fault)
                self.audit("failed", part=part, why=f"{type(error).__name__}: {error}")

    def _route(self, topic: str) -> list[tuple[Member, Subscription]]:
        """Find the receivers: each member once, by its first matching subscription."""
        route = self._routes.get(topic)
        if route is None:
            if len(self._routes) >= MAX_ROUTES:
                self._routes.clear()
            route = self._routes[topic] = []
            for member in self.members.values():
                wanted = next((each for each in member.subscriptions.values() if each.pattern.part(topic)), None)
                if wanted is not None and member.permissions.allow("receive", topic):
                    route.append((member, wanted))
        return route

    async def make_room(self, sender: Member, message: wire.Message) -> None:
        """Make room for a no_drop message's receivers here; raise RefusedError if that cannot be."""
        if receivers := self._holders(sender, message.topic):
            await self.store.make_room(len(wire.encode(message)), receivers)

    async def hold(
        self, sender: Member, message: wire.Message, *, shared: bool = False, taken: int | None = None
    ) -> None:
        """Keep a no_drop message until its receivers have acked it.

        Args:
            shared: whether other relays have it too, and may have receivers.
            taken: number under which it was taken from the sender; None means the message's own.

        Raises RefusedError: it has no receiver, or there is no room.
        """
        receivers = self._holders(sender, message.topic)
        if not receivers and not shared:
            alone = self.peers is not None and self.peers.state != CONNECTED
            other = ", and the other relays are out of reach" if alone else ""
            robot = robot_of(message.topic)
            why = f"robot {robot} is not here" if robot else f"topic {message.topic}: nobody receives it"
            raise RefusedError("no_receiver", why + other)
        if robot_of(message.topic) and not receivers and self.peers is not None:
            self.peers.awaits(sender.session, message)
        frame = wire.encode(message)
        number = message.seq if taken is None else taken
        if not await self.store.hold(sender.session, number, message.topic, frame, receivers, message.until_us):
            return
        self._show(message)
        for session in receivers:
            if session in self.members:
                self.members[session].wake()
        outgoing = Outgoing(message)
        for member, subscription in self._route(message.topic):
            if member is not sender and not member.acks:
                member.offer(subscription, outgoing)

    def _holders(self, sender: Member, topic: str) -> list[StoredSession]:
        """Find the sessions that should get a no_drop message: here, away, or back and about to subscribe again.

        A command waits for the session that has claimed its robot, here or away. Without one it waits for those who
        subscribe to this robot's topics alone, and never for who merely watches all.
        """
        robot = robot_of(topic)
        if robot and (session := self.claims.get(robot)) is not None:
            return [] if session is sender.session else [session]
        own = f"^/robots/{escaped(robot)}/" if robot else ""
        here = [
            member.session
            for member, subscription in self._route(topic)
            if member is not sender and member.acks and subscription.pattern.text.startswith(own)
        ]
        away = [
            each
            for each in self.store.sessions.values()
            if each is not sender.session and each not in here
            if any(wanted.text.startswith(own) and wanted.part(topic) for wanted in list(each.durable.values()))
            if Permissions(self.config.rules, each.identity).allow("receive", topic)
        ]
        return here + away

    def settled(self, message: Settled) -> None:
        """Tell the sender of a message its outcome, and remember that for its next connection."""
        outcomes = message.sender.outcomes
        outcomes[message.seq] = message
        if len(outcomes) > MOST:
            del outcomes[next(iter(outcomes))]
        self.tell_outcome(message)

    def tell_outcome(self, message: Settled) -> None:
        """Tell the sender of a message its outcome, if it is here."""
        if message.sender in self.members:
            about: dict[str, Any] = {"seq": message.seq, "receivers": message.receivers, "lost": message.lost}
            about |= {"why": message.why} if message.why else {}
            self.members[message.sender].tell("delivered", **about)

    def status(self) -> dict[str, Any]:
        """The relay's counts, and how it stands with the other relays."""
        members = list(self.members.values())
        subscriptions = [each for member in members for each in member.subscriptions.values()]
        return {
            "connections": len(members),
            "received": self.received,
            "sent": self._sent + sum(member.sent for member in members),
            "dropped": self._dropped + sum(each.dropped for each in subscriptions),
            "refused": self.audit.refused,
            "held": sum(session.held for session in self.store.sessions.values()),
            **({} if self.peers is None else {"nats": self.peers.state}),
        }

    def tick(self) -> None:
        """Publish the relay's state once a second, and forget what has expired."""
        payload = json.dumps(self.status()).encode()
        now_us = self.now_us()
        self.publish(None, wire.Message(STATUS, payload, sender=wire.OWN, stamp_us=now_us, at_us=now_us))
        for who, long_s in self.turns.take().items():
            self.audit("slow", who=who, longest_ms=round(1e3 * max(long_s), 1), times=len(long_s))
        self.audit.flush()
        if self.tape is not None:
            self.tape.tick()
        self.roster.tick()
        self.drivers.tick()
        self.quotas.tidy()
        self.store.tick(now_us)
        self.desk.tick()
        if self.peers is not None:
            self.peers.tick()
        for disk in self.disks:
            disk.tick()

    @property
    def ills(self) -> list[str]:
        """What is wrong with the relay's files, as far as it knows."""
        gone = [self.store.fault] * bool(self.store.fault) if self.store.there else ["the store's file was deleted"]
        return gone + [f"the disk stalls: {disk.part}" for disk in self.disks if disk.stalls]

    def close(self) -> None:
        """Finish the files."""
        self.drivers.tick(quiet_s=0.0)
        for each in self.own:
            with self.outliving(type(each).__name__):
                each.close()
        self.store.close()
        self.audit.close()


@functools.lru_cache(MAX_ROUTES)
def _any_whole(patterns: tuple[str, ...], topic: str) -> bool:
    return any(pattern(text).whole(topic) for text in patterns)

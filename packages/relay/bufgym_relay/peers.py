"""Relays that share topics over NATS, so that robots at one of them reach viewers at another.

A message published at one relay goes through a queue to all others, and from there to clients that *their* rules allow.
Rules with ``nats = true`` say which topics a relay gives to the others, and which it takes from them.

A no_drop message goes into a JetStream stream before it is acked. Each relay takes it from there and holds it for its
own receivers. NATS keeps it until every relay has taken it, also one that is away.
"""

import asyncio
import hashlib
import json
import re
import time
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from typing import Any, Final

from bufgym.utils.errors import BufgymError
from bufgym_relay import policies, protocol
from bufgym_relay.answers import Answers
from bufgym_relay.bus import HOLD, MESSAGE, TOLD, TRIES, Bus, options
from bufgym_relay.config import DEFAULT_CAPACITY, Nats, Rule
from bufgym_relay.hub import CONNECTED, Hub
from bufgym_relay.outgoing import Outgoing
from bufgym_relay.rules import NATS, Permissions
from bufgym_relay.stored import StoredSession
from bufgym_relay.subscriber import Subscription, make_one, next_lane
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.backoff import Backoff
from bufgym_robot.wire.clock import Delays
from bufgym_robot.wire.ledger import read
from bufgym_robot.wire.orders import STOP, heard_stops, is_stop, robot_of, stopped_robot
from bufgym_robot.wire.patterns import pattern
from bufgym_robot.wire.tasks import Tasks, until_one_ends

_RETRY_S: Final = 1.0
_CLOCK_S, _CLOCK_TRIES = 0.2, 5  # in which a relay says its time, before a command of it is taken
_SLOW_SHARE: Final = 0.25  # of late_s, beyond which fewer messages are taken at a time
_MOST_RELAYS: Final = 1_000


class Peers:
    """All other relays as one ``hub.Member``; it has no subscription while NATS is away."""

    acks = False

    def __init__(self, hub: Hub, settings: Nats) -> None:
        self._hub, self._settings, self._options = hub, settings, options(settings)
        self.session: StoredSession = hub.store.open("nats", NATS, False, 0, 0)
        self.permissions = Permissions(hub.config.rules, NATS)
        self.subscriptions: dict[str, Subscription] = {}
        self.sent = 0
        self.state = "connecting"
        """``CONNECTED``, or why there is no connection."""
        self._bus: Bus | None = None
        self._known: set[str] = set()
        self._delays: defaultdict[str, Delays] = defaultdict(Delays)
        self._awake = asyncio.Event()
        self._answers = Answers(hub)
        hub.claims.told = lambda robot, address: self._tell(robot=robot, at=address)
        self._telling: deque[dict[str, Any]] = deque()
        """What is to be said to the others before any message."""
        self._tasks = Tasks()

    async def start(self) -> None:
        """Begin to share. Without NATS the relay goes on alone, and tries again until NATS is there.

        Raises BufgymError: NATS does not let this relay in, or another relay has its name.
        """
        policy = await asyncio.to_thread(policies.warm, self._hub.config.policies[0])
        self._hub.join(self)
        tried: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._tasks.begin(self._run(policy, tried))
        await tried

    async def _run(self, policy: Any, tried: asyncio.Future[None]) -> None:
        """Connect, and again whenever the connection ends; say by ``tried`` how the first try ended."""
        backoff, most = Backoff(), 0
        while True:
            bus = Bus(self._settings, self._hub.config.store, self._note, most)
            try:
                await bus.open(self._options, self._heard, self._told, self._known)
                self._bus = bus
                backoff.connected()
                # Only now: while NATS is away nothing must queue up for it.
                everything = Subscription("all", pattern(""), policy, DEFAULT_CAPACITY)
                await self._hub.subscribe(self, everything)
                self._telling.clear()
                self._tell(ask=True)
                await self._hub.offer_latched(self, everything)
                self._becomes(CONNECTED)
                if not tried.done():
                    tried.set_result(None)
                await until_one_ends(self._send_all(bus), self._take_all(bus), bus.take_turns(), bus.watch(self._known))
            except Exception as error:  # whatever it is, the relay goes on alone
                fault = bus.fault(error)
                self._becomes(str(fault))
            finally:
                self._bus, most = None, bus.most
                self._hub.unsubscribe(self, "all")
                await bus.close()
            if not tried.done():
                if isinstance(fault, BufgymError):
                    tried.set_exception(fault)
                    return
                tried.set_result(None)
            await asyncio.sleep(backoff.delay_s())

    def _becomes(self, state: str) -> None:
        if state != self.state:
            self.state = state
            self._hub.audit("nats", state=state)

    async def close(self) -> None:
        """Leave the others."""
        await self._tasks.end()
        self._hub.leave(self)

    def reruled(self, rules: Sequence[Rule]) -> None:
        """Take new rules."""
        self.permissions = Permissions(rules, NATS)

    def _note(self, why: object) -> None:
        self._hub.audit.repeated(what="nats", code="wrong", why=str(why))

    def _goes(self, verb: Any, topic: str) -> bool:
        return not topic.startswith(f"/{wire.OWN}/") and self.permissions.allow(verb, topic)

    def offer(self, subscription: Subscription, outgoing: Outgoing) -> None:
        """Offer a message of this relay."""
        if is_stop(outgoing.message.topic):
            self._offer_stops(outgoing.message)
        elif not outgoing.message.no_drop and self._goes("receive", outgoing.message.topic):
            subscription.offer(outgoing.message.topic, (outgoing, time.time_ns() // 1000), outgoing.size_bytes)
            self._awake.set()

    async def _send_all(self, bus: Bus) -> None:
        """Send one message after the other, so that little waits outside the queue."""
        while True:
            await self._awake.wait()
            self._awake.clear()
            await self._tell_all(bus)
            while await make_one(list(self.subscriptions.values()), self._hub.making):
                pass
            while (lane := next_lane(list(self.subscriptions.values()), self._hub.clock())) is not None:
                item = lane.take(self._hub.clock())
                if item is not None:
                    outgoing, put_us = item.message
                    headers = {"Relay": self._settings.name, "Put": str(put_us), **self._left(outgoing.message)}
                    try:
                        await bus.publish(outgoing.message.topic, wire.encode(_undated(outgoing.message)), headers)
                        self.sent += 1
                    except wire.RefusedError as refused:
                        self._note(refused)
                lane.gone()
                await self._tell_all(bus)

    async def _tell_all(self, bus: Bus) -> None:
        while self._telling:
            about = {"relay": self._settings.name, "put": time.time_ns() // 1000}
            await bus.tell(json.dumps({**about, **self._telling.popleft()}).encode())

    def _offer_stops(self, message: wire.Message) -> None:
        if self._goes("receive", message.topic):
            stops = [stop.as_json() for stop in heard_stops(message)]
            self._tell(robot=stopped_robot(message.topic), stops=stops)

    def _tell(self, **said: Any) -> None:
        if self._bus is not None:  # else the others ask for all once it is back
            self._telling.append(said)
        self._awake.set()

    def _told(self, data: bytes) -> None:
        """Take what another relay says: a robot's stops, how a command ended, or a question for all stops."""
        try:
            said = json.loads(data)
        except (ValueError, RecursionError):
            said = None
        match said:
            case {"relay": str(relay), "put": int(put)}:
                self._delays[relay].extra_s(time.time() - put / 1e6, self._hub.clock())
        match said:
            case {"relay": str(), "clock": True}:
                pass
            case {"relay": str(), "ask": True}:
                self._tell(clock=True)
                for outgoing in self._hub.desk.said.values():
                    self._offer_stops(outgoing.message)
            case {"relay": str(), "robot": str(robot), "stops": list(stops)} if "/" not in robot:
                if self._goes("send", f"/robots/{robot}/{STOP}"):
                    self._hub.desk.take(robot, list(read(stops)), self, self.session.identity.key)
            case {"relay": str(relay), "robot": str(robot), "at": str(address)}:
                self._hub.claims.elsewhere(robot, relay[:100], address[:100])
            case {"relay": str(), "seq": int(number), "lost": int(lost), "why": str(why)}:
                self._answers.came(number, lost, why)
            case _:
                self._note(f"{TOLD}: {data[:60]!r}: nothing that a relay of this version says")

    def _heard(self, heard: Any) -> bool:
        """Publish a message of another relay here; return whether fewer should come at a time."""
        headers = heard.headers or {}
        relay, put = headers.get("Relay", ""), headers.get("Put", "")
        if not (relay and re.fullmatch("[0-9]{1,17}", put)):
            self._note(f"{MESSAGE}: a message without the headers Relay and Put")
            return False
        if len(self._delays) > _MOST_RELAYS:
            self._delays.clear()
        delay_s, late_s = time.time() - int(put) / 1e6, self._settings.late_s
        extra_s = self._delays[relay].extra_s(delay_s, self._hub.clock())
        if extra_s > late_s:
            self._note(f"relay {relay}: a message later than late_s = {late_s:g}")
        elif (message := self._read(heard)) is not None and not self._hub.is_no_drop(message.topic):
            if (dated := self._dated(message, headers, extra_s)) is not None:
                self._hub.publish(self, dated._replace(no_drop=False))
        in_turns = self._bus is not None and self._bus.most
        return extra_s > (_SLOW_SHARE * late_s if in_turns else late_s)

    def _read(self, heard: Any) -> wire.Message | None:
        """Decode a message of another relay; None if it is none, or may not come in."""
        try:
            message = wire.decode(heard.data)
            protocol.check_json(message)
        except BufgymError as error:
            self._note(error)
            return None
        return message if self._goes("send", message.topic) else None

    def _left(self, message: wire.Message) -> dict[str, str]:
        """Give the header with the time that a command has left, us: other relays have other clocks."""
        return {"Left": str(max(0, message.until_us - self._hub.now_us()))} if message.until_us else {}

    def _dated(
        self, message: wire.Message, headers: Mapping[str, str], extra_s: float, number: int = 0
    ) -> wire.Message | None:
        """Give a message of another relay its times by this relay's clock; None if it may not go on.

        The sender of a command, which has a ``number``, is told why, if its robot is here.
        """
        now_us, left = self._hub.now_us(), headers.get("Left", "")
        until_us = max(1, now_us + int(left) - round(extra_s * 1e6)) if re.fullmatch("[0-9]{1,15}", left) else 0
        here = message._replace(at_us=now_us, until_us=until_us)
        try:
            return self._hub.orders.dated(here, self.permissions.command_s(message.topic), now_us)
        except wire.RefusedError as refused:
            self._note(refused)
            if number not in (0, self.session.received) and self._hub.claims.get(robot_of(message.topic)) is not None:
                self._tell(seq=number, lost=0, why=str(refused))
            return None

    async def hold(self, sender: StoredSession, message: wire.Message) -> bool | None:
        """Give a no_drop message to the other relays.

        Return whether they may have it, None if NATS does not say whether it has it. Without NATS, they have not, but
        for what NATS may have been asked to take before, also by this relay's last run: to refuse that could be wrong.

        Raises RefusedError: NATS does not take it.
        """
        if not self._goes("receive", message.topic):
            return False
        frame = wire.encode(_undated(message))
        if self._bus is None:
            return None if message.seq == sender.doubtful else False
        id = self._id(sender, message)
        put_us = str(time.time_ns() // 1000)
        headers = {"Nats-Msg-Id": id, "Relay": self._settings.name, "Put": put_us, **self._left(message)}
        if not await self._bus.hold(message.topic, frame, headers):
            sender.doubtful = message.seq
            return None
        return True

    def _id(self, sender: StoredSession, message: wire.Message) -> str:
        """Name a no_drop message, the same when it is sent again."""
        origin = f"{self._settings.name}\n{sender.identity.key}\n{sender.name}\n".encode()
        frame = wire.encode(_undated(message)._replace(seen=""))
        return hashlib.blake2b(origin + frame, digest_size=16).hexdigest()

    def awaits(self, sender: StoredSession, message: wire.Message) -> None:
        """Note that another relay will say how a command of this one ended."""
        if sender is not self.session:
            self._answers.await_one(_number(self._id(sender, message)), sender, message)

    def tick(self) -> None:
        """Give up the answers that do not come, and let the others compare clocks."""
        self._answers.tick()
        if self._bus is not None:
            self._tell(clock=True)

    def tell(self, op: str, **fields: Any) -> None:
        """Tell the others how a command of theirs ended."""
        if op == "delivered":
            self._tell(seq=fields["seq"], lost=fields["lost"], why=fields.get("why", ""))

    async def _take_all(self, bus: Bus) -> None:
        while True:
            await self._take(await bus.next())

    async def _take(self, heard: Any) -> None:
        """Hold a no_drop message of another relay for the receivers here; if there is no room, try again later."""
        headers: Mapping[str, str] = heard.headers or {}
        id, relay = headers.get("Nats-Msg-Id", ""), headers.get("Relay", "")
        if not (id and relay):
            self._note(f"{HOLD}: a message without the headers Nats-Msg-Id and Relay")
            await heard.term()
            return
        number = _number(id)
        message = None if relay == self._settings.name else self._read(heard)
        if message is not None and "Left" in headers and relay not in self._delays:
            # It may be as old as NATS keeps it: how old, its relay's clock tells.
            if heard.metadata.num_delivered < _CLOCK_TRIES:
                self._tell(ask=True)
                await heard.nak(delay=_CLOCK_S)
                return
            self._note(f"relay {relay} does not say its time: a command of it, whose age is not known, is dropped")
            message = None
        if message is not None and re.fullmatch("[0-9]{1,17}", put := headers.get("Put", "")):
            extra_s = self._delays[relay].extra_s(time.time() - int(put) / 1e6, self._hub.clock())
            message = self._dated(message, headers, extra_s, number)
        # The last one comes again if NATS did not hear its ack.
        if message is not None and self._hub.is_no_drop(message.topic) and number != self.session.received:
            try:
                await self._hub.hold(self, message, taken=number)
            except wire.RefusedError as refused:
                if refused.code != "no_receiver":
                    self._note(refused)
                    if heard.metadata.num_delivered < TRIES:
                        await heard.nak(delay=_RETRY_S)
                        return
        # Also what was not wanted, or came twice: NATS must not give it again.
        await heard.ack()

    def _ignore(self, *words: Any, **fields: Any) -> None:
        """Do nothing: the others are told nothing, no message is held for them, and they end with the relay."""

    wake = end = _ignore


def _number(id: str) -> int:
    """Give a message's number by its name at NATS."""
    return int(hashlib.blake2b(id.encode(errors="replace"), digest_size=6).hexdigest(), 16)


def _undated(message: wire.Message) -> wire.Message:
    """Take a message's times off, which are by this relay's clock."""
    return message._replace(at_us=0, until_us=0)

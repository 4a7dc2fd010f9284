"""Store of no_drop messages, kept on disk until each of their receivers has acked them.

A session outlives its connections. The relay numbers the messages that it sends to a session, and knows the highest
number received from it. Both are committed with the message itself, before anything is acked. So a message is taken
once however often it is sent again, and a killed relay resumes where it was. Space is bounded. A message that has no
room is refused to its sender; but a receiver that acks nothing loses its own oldest before others wait for it.

The disk has a thread, which does everything in the order in which the event loop asks for it. While it stalls, sessions
come and go, and commands wait.
"""

import asyncio
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from bufgym_relay.audit import Audit
from bufgym_relay.config import Config
from bufgym_relay.disk import STALL_S, Disk
from bufgym_relay.held import Held
from bufgym_relay.rules import Identity
from bufgym_relay.stored import NOT_REACHED, Settled, StoredSession
from bufgym_robot.wire.ledger import Stop
from bufgym_robot.wire.messages import RefusedError
from bufgym_robot.wire.patterns import Pattern

_POLL_S: Final = 0.005


class Store:
    """Sessions and the messages held for them; without a folder they are in memory only.

    ``tell`` is called with each message as soon as it is settled.
    """

    def __init__(
        self, config: Config, audit: Audit, tell: Callable[[Settled], None], clock: Callable[[], float]
    ) -> None:
        self.limits, self._quota = config.store, config.limits
        self._audit, self._clock = audit, clock
        self.disk = Disk("held messages", audit)
        self._held = Held(config, self.disk, audit, tell)
        self.sessions = {session.key: session for session in self._held.load()}
        for session in self.sessions.values():
            session.away_s = clock()
        self._waiting_bytes = 0

    @property
    def there(self) -> bool:
        """Whether the file was where a relay that starts anew looks for it, at the last tick or transaction."""
        return self._held.there

    @property
    def fault(self) -> str:
        """Why the file could not be written at the last try; empty if it could."""
        return self._held.fault

    @property
    def held_bytes(self) -> int:
        """Bytes held in total."""
        return self._held.bytes

    def reserve(self, size_bytes: int) -> bool:
        """Count the bytes of a message that is to be held; return False if too many wait for the disk."""
        if self._waiting_bytes and self._waiting_bytes + size_bytes > self.limits.bytes:
            return False
        self._waiting_bytes += size_bytes
        return True

    def release(self, size_bytes: int) -> None:
        """Count them no more."""
        self._waiting_bytes -= size_bytes

    async def catch_up(self, identity: Identity, name: str, received: int, numbered: int) -> None:
        """Give a session numbers that are at least its client's, which knows more than a store that went back."""
        session = self.sessions.get((identity.key, name))
        if session is not None and (received > session.received or numbered > session.numbered):
            await self.disk.do(self._held.remember, session, received, numbered)

    async def orders_done(self, identity: Identity, name: str) -> None:
        """Wait until a session's orders of an earlier connection are done, unless the disk stalls.

        Otherwise its client would not know that a message was taken, and might give another one its number.
        """
        session, until_s = self.sessions.get((identity.key, name)), self._clock() + STALL_S
        while session is not None and session.orders and self._clock() < until_s:
            await asyncio.sleep(_POLL_S)

    def open(self, name: str, identity: Identity, temporary: bool, received: int, acked: int) -> StoredSession:
        """Open the session of this name; a new session begins at the client's numbers.

        If the identity has too many, or all at its address together, the one goes that has been away for longest.

        Raises RefusedError: all of them are here, or their orders wait for the disk.
        """
        session = self.sessions.get((identity.key, name))
        if session is None:
            others, most = self.sessions.values(), self._quota.sessions
            self._free_place([one for one in others if one.identity.key == identity.key], most)
            at_address = [one for one in others if one.identity.address == identity.address]
            self._free_place(at_address, most * self._quota.identities)
            session = StoredSession(name, identity, temporary, acked, received)
            self.sessions[session.key] = session
        before, session.identity, session.away_s = session.identity, identity, math.inf
        if session.kept and before.as_json() != identity.as_json():
            self.disk.later(self._held.remember, session)
        return session

    def _free_place(self, sessions: Sequence[StoredSession], most: int) -> None:
        if len(sessions) >= most:
            oldest = min(sessions, key=lambda one: one.unused_s)
            if oldest.unused_s == math.inf:
                raise RefusedError("too_many", f"must be at most {most} sessions")
            self._expire(oldest)

    def left(self, session: StoredSession) -> None:
        """Note the end of a session's connection; forget messages that nobody will ask for."""
        session.away_s = self._clock()
        if session.temporary or not session.kept:
            self.forget(session)

    def forget(self, session: StoredSession) -> None:
        """Forget a session; messages held for it are lost. A disk that cannot be written keeps it for later."""
        if self.sessions.get(session.key) is session:
            del self.sessions[session.key]
            if session.kept:
                self.disk.later(self._forget, session)

    def _forget(self, session: StoredSession) -> None:
        if not self._held.forget(session):
            self.disk.on_loop(self.sessions.setdefault, session.key, session)

    def claimed(self, session: StoredSession, robot: str) -> None:
        """Note the robot that a session has claimed to be, also for a relay that starts anew."""
        if session.robot != robot or not session.kept:
            session.robot, session.kept = robot, True
            self.disk.later(self._held.remember, session)

    async def want(self, session: StoredSession, id: str, pattern: Pattern) -> None:
        """Hold matching messages while the session is away.

        If its identity's sessions have too many, also of connections that have ended, the one goes that has been away
        for longest: each no_drop message is compared with all of them.

        Raises RefusedError: those that are here have too many; or the disk cannot be written.
        """
        if (before := session.durable.get(id)) and before.text == pattern.text:
            return
        own = [one for one in self.sessions.values() if one.identity.key == session.identity.key and one.durable]
        costs = {one: sum(each.cost for each in list(one.durable.values())) for one in own}
        left = self._quota.subscriptions - pattern.cost + (before.cost if before else 0)
        if sum(cost for one, cost in costs.items() if one.unused_s == math.inf) > left:
            raise RefusedError("too_many", f"must be at most {self._quota.subscriptions} durable subscriptions")
        while sum(costs.values()) > left:
            oldest = min(costs, key=lambda one: one.unused_s)
            del costs[oldest]
            self._expire(oldest)
        session.kept = True
        await self.disk.do(self._held.want, session, id, pattern)

    def want_no_more(self, session: StoredSession, id: str) -> None:
        """End that."""
        if session.durable.pop(id, None) is not None:
            self.disk.later(self._held.want_no_more, session, id)

    async def hold(
        self,
        sender: StoredSession,
        seq: int,
        topic: str,
        frame: bytes,
        receivers: Sequence[StoredSession],
        until_us: int = 0,
    ) -> bool:
        """Store the sender's message number ``seq`` on disk for these receivers; return whether it is new.

        Without receivers, whom other relays have, the number alone is taken. ``until_us`` is its deadline, or 0.

        Raises RefusedError: there is no room; then its number is not used.
        """
        for session in (sender, *receivers):
            session.kept = True
        # ``kept`` is set before the wait: a session that leaves meanwhile must not be forgotten with its message.
        new: bool = await self.disk.do(self._held.hold, sender, seq, topic, frame, receivers, until_us)
        return new

    async def make_room(self, size_bytes: int, receivers: Sequence[StoredSession]) -> None:
        """Make room for a message; raise RefusedError if that cannot be."""
        await self.disk.do(self._held.make_room, size_bytes, receivers)

    def next(self, session: StoredSession, after: int) -> asyncio.Future[tuple[int, str, bytes]]:
        """Find number, topic and frame of the session's next message; with no frame, none is left up to the number."""
        return self.disk.do(self._held.next, session, after)

    def acked(self, session: StoredSession, number: int, why: str = "") -> None:
        """Note that the session has processed all messages up to this number, and ``why`` it refused the last."""
        if why:
            session.answers[number] = why
        session.acked = max(session.acked, number)
        if session.held > 0 and not session.settling:
            session.settling = True
            self.disk.later(self._held.settle_acked, session)

    def denied(self, session: StoredSession, number: int, why: str) -> None:
        """Drop a message that the session must not have any more."""
        session.answers[number] = why  # at once: an ack of a later one may be written first
        self.disk.later(self._held.deny, session, number, why)

    def waits(self, sender: StoredSession, seq: int) -> asyncio.Future[bool]:
        """Whether a message of this sender is still held."""
        return self.disk.do(self._held.waits, sender, seq)

    def tick(self, now_us: int) -> None:
        """Forget the sessions that have been away for too long, counted while the relay runs, and what is too late."""
        if self.disk.idle:
            self.disk.soon(0, self._held.look)
            if any(session.held for session in self.sessions.values()):
                self.disk.soon(0, self._held.expire, now_us, NOT_REACHED)
        for session in list(self.sessions.values()):
            if session.acked > session.settled:
                self.acked(session, session.acked)  # what could not be written before
            if session.unused_s < self._clock() - self.limits.keep_s:
                self._expire(session)

    def _expire(self, session: StoredSession) -> None:
        self._audit("forgotten", session=session.name, held=session.held, **session.identity.as_json())
        self.forget(session)

    def robots(self) -> list[tuple[str, int, str]]:
        """Read the robots that were here: name, time of the last status in us since 1970, what it said as JSON.

        For the start alone, before the disk has its thread.
        """
        return self._held.facts.robots()

    def keep_robots(self, rows: Sequence[tuple[str, int, str]], most: int) -> None:
        """Keep these for later, as ``robots`` returns them, and of all only the ``most`` that were here last."""
        if rows:
            self.disk.soon(sum(len(said) for _, _, said in rows), self._held.facts.keep_robots, rows, most)

    def forget_robot(self, name: str) -> None:
        """Remove a robot that was here."""
        self.disk.soon(0, self._held.facts.forget_robot, name)

    def stops(self) -> Iterator[tuple[str, Stop]]:
        """Read the robots' stops; for the start alone."""
        return self._held.facts.stops()

    def keep_stops(self, robot: str, stops: Sequence[Stop]) -> asyncio.Future[None]:
        """Write a robot's stops; the future raises RefusedError if the disk cannot be written."""
        return self.disk.do(self._held.facts.keep_stops, robot, tuple(stops))

    def close(self) -> None:
        """Close the file, when all is written."""
        self.disk.close(self._held.close)

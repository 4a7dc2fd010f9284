"""The relay's part in stops: it takes them from all, tells everybody at once, and confirms what is on the disk."""

import asyncio
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from bufgym_relay.audit import Audit
from bufgym_relay.orders import Orders
from bufgym_relay.outgoing import Outgoing
from bufgym_relay.rules import Identity
from bufgym_relay.store import Store
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.ledger import Stop
from bufgym_robot.wire.messages import RefusedError
from bufgym_robot.wire.orders import stopped_robot, told
from bufgym_robot.wire.tasks import Tasks


class Desk:
    """Ledgers of all robots; ``send`` gives a message to all but the member that said it."""

    def __init__(
        self,
        orders: Orders,
        store: Store,
        audit: Audit,
        now_us: Callable[[], int],
        send: Callable[[Any, Outgoing], None],
        holding: Tasks,
    ) -> None:
        self._orders, self._store, self._audit, self._now_us = orders, store, audit, now_us
        self._send, self._holding = send, holding
        self.said: dict[str, Outgoing] = {}
        """Topic -> the message that says a robot's stops, for later subscribers."""
        self._unwritten = dict[str, None]()
        """Robots whose stops are not on the disk as they are here."""
        for robot, stop in store.stops():
            if orders.take(robot, [stop], ""):
                self._told(robot)

    def order(self, message: wire.Message, by: str, identity: Identity) -> asyncio.Future[None]:
        """Take a stop or a release that a client says; the future is done when it is on the disk.

        Raises RefusedError: it is neither, or releases another stop.
        """
        robot = stopped_robot(message.topic)
        new = self._orders.ordered(message, by, identity.key)
        for stop in new:
            self._audit("stop" if stop.holds else "release", robot=robot, id=stop.id, by=by, **identity.as_json())
        if new:
            self._send(None, self._told(robot))
        return self._keep(robot)

    def take(self, robot: str, stops: Sequence[Stop], sender: Any, owner: str) -> None:
        """Take what another party knows, the robot or other relays; ``sender`` is not told its own."""
        if self._orders.take(robot, stops, owner):
            self._send(sender, self._told(robot))
            self._holding.begin(self._kept(robot))

    def _told(self, robot: str) -> Outgoing:
        message = told(robot, self._orders.ledgers[robot], self._now_us())
        self.said.pop(message.topic, None)
        outgoing = self.said[message.topic] = Outgoing(message)
        if len(self.said) > len(self._orders.ledgers):
            for topic in [one for one in self.said if stopped_robot(one) not in self._orders.ledgers]:
                self._audit("forgotten", topic=topic, why="too many robots with stops")
                del self.said[topic]
                self._holding.begin(self._kept(stopped_robot(topic)))
        return outgoing

    def _keep(self, robot: str) -> asyncio.Future[None]:
        kept = self._store.keep_stops(robot, list(self._orders.ledgers.get(robot, ())))
        kept.add_done_callback(partial(self._written, robot))
        return kept

    def _written(self, robot: str, kept: asyncio.Future[None]) -> None:
        self._unwritten.pop(robot, None)
        if kept.cancelled() or kept.exception() is not None:
            self._unwritten[robot] = None

    def tick(self) -> None:
        """Write one robot's stops again that could not be written; when that succeeds, the others'."""
        if self._unwritten:
            self._holding.begin(self._rewritten())

    async def _rewritten(self) -> None:
        for robot in list(self._unwritten):
            await self._kept(robot)
            if robot in self._unwritten:
                break

    async def _kept(self, robot: str) -> None:
        try:
            await self._keep(robot)
        except RefusedError as refused:
            self._audit.repeated(what="store", code=refused.code, why=str(refused))

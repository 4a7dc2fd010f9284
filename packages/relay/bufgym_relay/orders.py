"""A relay's view of commands: deadlines, and the stops that each robot has."""

from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress

from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.ledger import MOST_CHARACTERS, Ledger, Stop
from bufgym_robot.wire.messages import Message, RefusedError
from bufgym_robot.wire.orders import MOST_ROBOTS, STOP, moves, order, robot_of, stopped_robot


class Orders:
    """A relay's view of commands: deadlines, and the stops that each robot has."""

    def __init__(self) -> None:
        self.ledgers: dict[str, Ledger] = {}
        """Robot -> its stops, the robot whose stops changed longest ago first."""
        self.is_here: Callable[[str], bool] = lambda robot: False
        """Whether there is such a robot."""
        self._owners: dict[str, str] = {}
        """Robot -> key of the identity that said its first stop."""

    def dated(self, message: Message, most_s: float, now_us: int) -> Message:
        """Give a message that was taken at ``at_us`` its deadline, and a command the stops that are known.

        Raises RefusedError: the deadline is over, or a stop of the robot holds.
        """
        if message.until_us and now_us > message.until_us:
            late = f"{(now_us - message.until_us) / 1e6:.1f} s after its deadline"
            raise RefusedError("too_late", f"topic {message.topic}: came {late}")
        robot = robot_of(message.topic)
        if not robot:
            return message
        latest_us = message.at_us + round(most_s * 1e6)
        until_us = min(message.until_us or latest_us, latest_us)
        if now_us > until_us:
            raise RefusedError("too_late", f"topic {message.topic}: waited longer than the {most_s:g} s of its rule")
        ledger = self.ledgers.get(robot)
        if ledger is not None and moves(message):
            if ledger.held:
                raise RefusedError("stopped", f"{robot} was stopped by {ledger.by}: release it first")
            message = message._replace(seen=message.seen or ledger.seen)
        return message._replace(until_us=until_us)

    def ordered(self, message: Message, by: str, owner: str) -> list[Stop]:
        """Take a stop or a release that a client says, as ``by``; return what is new.

        Raises RefusedError: it is neither, it releases another stop, or there are too many robots with stops.
        """
        robot, said = stopped_robot(message.topic), order(message)
        if robot not in self.ledgers and said["command"] == STOP:
            self._make_room(robot, owner)
        ledger = self.ledgers.get(robot) or Ledger()
        try:
            if said["command"] == STOP:
                new = ledger.say(said["id"], by[:MOST_CHARACTERS], message.at_us)
            else:
                new = ledger.release(said["of"].split(), by[:MOST_CHARACTERS], message.at_us)
        except BufgymError as error:
            raise RefusedError("stopped", f"{robot} {error}") from None
        if new:
            self._keep(robot, ledger, owner)
        return new

    def take(self, robot: str, stops: Iterable[Stop], owner: str) -> list[Stop]:
        """Take what another party knows of a robot's stops; return what is new."""
        ledger = self.ledgers.get(robot)
        if ledger is None:
            with suppress(RefusedError):
                self._make_room(robot, owner)
                ledger = Ledger()
        new = [] if ledger is None else ledger.take(stops)
        if ledger is not None and new:
            self._keep(robot, ledger, owner)
        return new

    def _keep(self, robot: str, ledger: Ledger, owner: str) -> None:
        self.ledgers.pop(robot, None)
        self.ledgers[robot] = ledger
        self._owners.setdefault(robot, owner)

    def _make_room(self, robot: str, owner: str) -> None:
        """Forget a robot whose stops are all released, of the identity that has the most; a stop that holds stays.

        For a robot that is here, also one goes that is not.

        Raises RefusedError: there is none.
        """
        if len(self.ledgers) < MOST_ROBOTS:
            return
        shares = Counter(self._owners.values())
        largest = max(shares, key=shares.__getitem__)
        its = [one for one, own in self._owners.items() if own == largest]
        gone = next((one for one in self.ledgers if self._owners[one] == largest and not self.ledgers[one].held), "")
        if not gone and self.is_here(robot):
            gone = next((one for one in its if not self.is_here(one)), "")
        if not gone and shares[owner] * 2 > shares[largest]:
            raise RefusedError("too_many", f"must be at most {MOST_ROBOTS} robots with stops")
        gone = gone or its[0]
        del self.ledgers[gone], self._owners[gone]

    def is_late(self, message: Message, now_us: int) -> bool:
        """Whether a message's deadline is over."""
        return 0 < message.until_us < now_us

    def is_over(self, message: Message, now_us: int) -> bool:
        """Whether a command that waited is not to be sent on: it is late, or a stop has withdrawn it."""
        if self.is_late(message, now_us):
            return True
        ledger = self.ledgers.get(robot_of(message.topic))
        return ledger is not None and bool(ledger.refusal(message.seen)) and moves(message)

"""Commands that went to other relays: how each ended, which the relay where its robot is says."""

from typing import Final

from bufgym_relay.hub import Hub
from bufgym_relay.stored import Settled, StoredSession
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import UNKNOWN

_MOST_EARLY: Final = 256
_GRACE_US: Final = 2_000_000  # time beyond a command's deadline for the answer to come


class Answers:
    """The answers that are awaited."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._awaited: dict[int, tuple[StoredSession, int, int]] = {}
        """Number of a command at NATS -> its sender, the sender's number, its deadline."""
        self._early: dict[int, tuple[int, str]] = {}
        """Answers that came before they were awaited, which NATS had not confirmed yet; or are of other relays."""

    def await_one(self, number: int, sender: StoredSession, message: wire.Message) -> None:
        """Await the answer to a command."""
        self._awaited[number] = sender, message.seq, message.until_us
        if number in self._early:
            self.came(number, *self._early.pop(number))

    def came(self, number: int, lost: int, why: str) -> None:
        """Tell the sender of a command how it ended."""
        sender, seq, _ = self._awaited.pop(number, (None, 0, 0))
        if sender is not None:
            self._hub.settled(Settled(sender, seq, 1, lost, why))
            return
        self._early[number] = lost, why
        if len(self._early) > _MOST_EARLY:
            del self._early[next(iter(self._early))]

    def tick(self) -> None:
        """Give up what is not answered by now: no relay has the robot, or its answer was lost on the way."""
        now_us = self._hub.now_us()
        for number in [one for one, (_, _, until_us) in self._awaited.items() if until_us + _GRACE_US < now_us]:
            self.came(number, 1, f"no other relay says that its robot was reached: {UNKNOWN}")

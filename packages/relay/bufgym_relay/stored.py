"""A client's session as the relay keeps it, and how a message ended."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from bufgym_relay.rules import Identity
from bufgym_robot.wire.messages import UNKNOWN, RefusedError
from bufgym_robot.wire.patterns import Pattern

NOT_REACHED: Final = "not reached: its robot was away until the deadline"


@dataclass(eq=False)
class StoredSession:
    """A client's session as the relay keeps it, over all its connections."""

    name: str
    identity: Identity
    temporary: bool  # whether the session ends with its connection
    received: int = 0  # highest number of a no_drop message taken from it
    numbered: int = 0  # highest number of a no_drop message for it
    held: int = 0  # number of messages for it that are not acked
    held_bytes: int = 0
    durable: dict[str, Pattern] = field(default_factory=dict)  # id -> pattern of messages held for it while away
    away_s: float = math.inf  # beginning of its absence, by the store's clock; infinity while it is here
    kept: bool = False  # whether the store was asked to remember it
    orders: int = 0  # number of its orders that wait for the disk
    id: int | None = None  # id on disk, which only the disk's thread reads
    acked: int = 0  # highest number that it has acked
    sent: int = 0  # highest number that a connection of it was given: what it has not acked it may have executed
    doubtful: int = 0  # number of a message of it of which nobody knows whether other relays have it, or 0
    settled: int = 0  # highest number up to which acks are written
    settling: bool = False  # whether acks wait to be written
    robot: str = ""  # the robot that it has claimed to be
    heard_s: float = -math.inf  # when its client said something last, by the relay's clock
    answers: dict[int, str] = field(default_factory=dict)  # number of a message for it -> why it was refused
    outcomes: dict[int, "Settled"] = field(default_factory=dict)  # the last messages of it that are settled

    def greeted(self, open: Sequence[int], whys: Mapping[int, str], now_s: float) -> None:
        """Take the client's hello: of which of its messages it does not know how they ended, and what it refused."""
        self.answers.update(whys)
        if self.heard_s == -math.inf and self.received + 1 in open:
            self.doubtful = self.received + 1  # the relay's last run may have given it to others, and was killed
        self.heard_s = now_s

    def doubted(self, refused: RefusedError, number: int) -> RefusedError:
        """Say of a message that is refused whether nobody knows what became of it before."""
        if number != self.doubtful or refused.code == "busy":
            return refused
        self.doubtful = 0
        return RefusedError(refused.code, f"{refused}: {UNKNOWN}")

    @property
    def key(self) -> tuple[str, str]:
        """Identity and name; the same name under another identity is another session."""
        return self.identity.key, self.name

    def why_not(self, number: int, why: str) -> str:
        """Say why a message for it ends without its ack: ``why``, unless it was given to it before."""
        return UNKNOWN if number <= self.sent else why

    @property
    def unused_s(self) -> float:
        """Time from which on it may be forgotten; infinity while it is here, or an order of it waits."""
        return math.inf if self.orders else self.away_s


def command_number(session: StoredSession, seq: int) -> int:
    """Give a command's number: the same however often its client sends it."""
    about = f"{session.identity.key}\n{session.name}\n{seq}".encode()
    return int.from_bytes(hashlib.blake2b(about, digest_size=6).digest(), "big")


class Settled(NamedTuple):
    """A message that no receiver waits for any more."""

    sender: StoredSession
    seq: int
    receivers: int
    lost: int  # number of receivers that never acked it
    why: str = ""  # why its receiver refused it, or did not get it

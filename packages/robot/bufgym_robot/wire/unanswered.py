"""A client's unanswered no_drop messages: numbered, held until the relay answers, renumbered if refused.

A command to a robot is open after that until the relay says what became of it.

The relay takes number k only after k - 1, and answers each once, in order. A refused number stays unused. So once all
messages under way are answered, the messages behind the refused one are sent again from that number on.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from bufgym.utils.errors import BufgymError
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.orders import robot_of

AGAIN = ("out_of_order", "busy")
"""Codes of refusals after which a message is sent again: it is behind a refused one, or the relay's disk stalls."""


@dataclass
class Pending:
    """A message on its way."""

    message: wire.Message
    answered: asyncio.Future[None]  # done when the relay holds the message; a BufgymError if it was refused
    put_s: float = 0.0  # when it was put, by the client's clock
    withdrawn: bool = False  # whether a stop has withdrawn it
    sent: bool = False  # whether it was sent, and not refused: the relay may have it


class Unanswered:
    """The messages of one session, in order."""

    def __init__(
        self,
        dated: Callable[[wire.Message, float], wire.Message] = lambda message, put_s: message,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``dated`` gives a message its deadline by when it was put, or raises a BufgymError where that is over."""
        self._dated, self._clock = dated, clock
        self.acked = 0  # highest number that the relay holds
        self.window = 1  # n_T, the most messages unanswered at a time
        self._waiting: deque[Pending] = deque()
        self._sent: deque[Pending] = deque()
        self._open: dict[int, Pending] = {}
        """Number -> command that the relay holds, and of which the robot has not said how it went."""
        self._again: list[Pending] = []
        self._refused = 0  # refusals since the last ack, while more are to come
        self._check: Callable[[wire.Message], object] = lambda message: None

    @property
    def awaited(self) -> bool:
        """Whether an answer is to come."""
        return bool(self._waiting or self._sent or self._open)

    @property
    def open(self) -> list[int]:
        """Numbers of the messages that the relay may hold, or have held."""
        return [*self._open, *range(self.acked + 1, self.acked + 1 + len(self._sent))]

    def put(self, message: wire.Message) -> asyncio.Future[None]:
        """Add a message; the future is done once the relay holds it, or the robot has executed it."""
        pending = Pending(message, asyncio.get_running_loop().create_future(), self._clock())
        self._waiting.append(pending)
        return pending.answered

    def next(self) -> wire.Message | None:
        """Number the next message to send; None if nothing waits, the window is full or refusals are to come.

        A message that was put before the relay said how much it takes fails here if it is too large.
        """
        while self._waiting and not self._refused and len(self._sent) < self.window:
            pending = self._waiting.popleft()
            if pending.withdrawn:
                continue
            try:
                self._check(message := self._dated(pending.message, pending.put_s))
            except BufgymError as error:
                _settle(pending, BufgymError(f"{error}: {wire.UNKNOWN}") if pending.sent else error)
            else:
                pending.sent = True
                self._sent.append(pending)
                return message._replace(seq=self.acked + len(self._sent))
        return None

    def ack(self, seq: int) -> None:
        """Note that the relay holds this message and all before it."""
        while self._sent and self.acked < seq and not self._refused:
            self.acked += 1
            pending = self._sent.popleft()
            if robot_of(pending.message.topic):
                self._open[self.acked] = pending
            else:
                _settle(pending)

    def delivered(self, seq: int, why: str) -> None:
        """Note what became of a message: executed, or ``why`` not."""
        self.ack(seq)
        if (pending := self._open.pop(seq, None)) is not None:
            _settle(pending, BufgymError(f"topic {pending.message.topic}: {why}") if why else None)

    def expects(self, topic: str, seq: int | None) -> bool:
        """Whether the next answer is about this message."""
        expected = self._sent[0].message.topic if self._sent else None
        return topic == expected and seq in (None, self.acked + self._refused + 1)

    def refuse(self, code: str, why: str) -> None:
        """Note that the relay refused the oldest unanswered message."""
        if not self._sent:
            return
        pending = self._sent.popleft()
        if code in AGAIN:
            pending.sent = False
            self._again.append(pending)
        else:
            _settle(pending, BufgymError(f"topic {pending.message.topic}: refused: {code}: {why}"))
        # Messages behind a refused one are refused too: nothing new is sent until all their answers are in.
        self._refused += 1
        if not self._sent:
            self._refused = 0
            self._waiting.extendleft(reversed(self._again))
            self._again.clear()

    def resume(
        self, received: int, window: int, check: Callable[[wire.Message], object] = lambda message: None
    ) -> None:
        """Resume after a reconnect: the relay holds all up to ``received``, and the rest is sent again.

        ``check`` raises BufgymError for a message that this relay does not take.
        """
        self.window, self._check = window, check
        self.ack(received)
        self._waiting.extendleft(reversed([*self._again, *self._sent]))
        self._again.clear()
        self._sent.clear()
        self._refused = 0
        self.acked = received

    def withdraw(self, robot: str, why: str) -> None:
        """Withdraw the commands to a robot: none is sent from now on, and those that wait have failed."""
        for pending in (*self._open.values(), *self._again, *self._sent, *self._waiting):
            if robot_of(pending.message.topic) == robot:
                pending.withdrawn = True
                _settle(pending, BufgymError(f"topic {pending.message.topic}: {why}"))

    def give_up(self, why: str) -> None:
        """Fail all messages, because no answer will come."""
        for pending in (*self._open.values(), *self._again, *self._sent, *self._waiting):
            _settle(pending, BufgymError(why))


def _settle(pending: Pending, error: BufgymError | None = None) -> None:
    if pending.answered.done():  # the waiting task has given up
        return
    if error is None:
        pending.answered.set_result(None)
    else:
        pending.answered.set_exception(error)
        pending.answered.exception()  # marks the error as seen, because nobody may await it

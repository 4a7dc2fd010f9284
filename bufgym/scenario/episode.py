"""What a scenario draws: an ``Episode``, from separate random streams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.kernel import records
from bufgym.model.buffer import MESSAGE
from bufgym.model.checks import whole
from bufgym.model.link import Link
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic, check_ack_delay, check_window


class Streams(NamedTuple):
    """One random generator for each source of randomness.

    Fields:
        arrival: times, sizes and motion of messages.
        link: which trace, and where on it an episode begins.
        policy: draws of randomised policies.
    """

    arrival: np.random.Generator
    link: np.random.Generator
    policy: np.random.Generator

    @staticmethod
    def seeded(seed: int | np.random.SeedSequence) -> Streams:
        """Three independent streams from one seed."""
        root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(whole("seed", seed))
        return Streams(*(np.random.Generator(np.random.PCG64(child)) for child in root.spawn(3)))


@dataclass(frozen=True, eq=False)
class Episode:
    """One drawn episode; nothing in it is random any more."""

    arrivals: NDArray[Any]
    """MESSAGE[n], in order of arrival (``arrival_us`` non-decreasing from 0, x non-decreasing)."""
    link: Link
    """The capacity trace that carries them, and where on it the episode begins."""
    first_decision: int = 0
    """Sequence number of the first arrival that a policy decides on; those before it are accepted."""
    last_decision: int = 2**31
    """Sequence number of the last arrival that a policy decides on; those after it are accepted."""
    window: int = 1
    """n_T: messages in flight (sent and not yet acknowledged) at most."""
    ack_delay_us: int = 0
    """From a message's last byte on the link to its ack, us; 0: the sender does not wait for acks."""
    encodings: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    """int64[n], bytes of the messages in other encodings, by name; where one is missing, sizes stay the same."""
    consumers: int = 1
    """Receivers of each message: a client that sends copies sends so many."""

    def __post_init__(self) -> None:
        check_window(self.window)
        check_ack_delay(self.ack_delay_us)

    def with_uniforms(self, rng: np.random.Generator) -> Episode:
        """The same episode with a fresh uniform draw beside each arrival, for randomised policies.

        ``Scenario.draw`` leaves these draws at 0: an agent in an environment has randomness of its own.
        """
        arrivals = self.arrivals.copy()
        arrivals["uniform"] = rng.random(len(arrivals))
        return replace(self, arrivals=arrivals)

    def encoded(self, encoding: str) -> Episode:
        """The same messages in another encoding."""
        if encoding not in self.encodings:
            return self
        arrivals = self.arrivals.copy()
        arrivals["size_bytes"] = self.encodings[encoding]
        return replace(self, arrivals=arrivals)

    def copied(self, topics: int) -> Episode:
        """One copy of each message for each consumer: copy c of topic t is on topic c x ``topics`` + t."""
        n = len(self.arrivals)
        arrivals = np.repeat(self.arrivals, self.consumers).view(type(self.arrivals))
        arrivals["topic"] += topics * np.tile(np.arange(self.consumers), n)
        arrivals["seq"] = np.arange(len(arrivals))
        return replace(self, arrivals=arrivals, consumers=1)


class Scenario(Protocol):
    """A family of episodes, frozen: what derives from its parameters is computed from them."""

    @property
    def value(self) -> Value:
        """The V that its QoI is measured with."""

    @property
    def max_messages(self) -> int:
        """No episode has more arrivals than this."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The rules of its topics; none where there is one queue."""

    def draw(self, streams: Streams) -> Episode:
        """One episode."""


def messages(
    arrival_us: NDArray[np.int64], size_bytes: NDArray[np.int64] | int, x: NDArray[np.float64] | None = None
) -> NDArray[Any]:
    """MESSAGE[n] from columns; x defaults to the frame index. Times and x must not decrease, sizes be >= 1 byte."""
    arrivals = unchecked_messages(arrival_us, size_bytes, x)
    if len(arrivals) == 0:
        raise BufgymError("an episode needs at least one message")
    if arrivals["arrival_us"][0] < 0 or (np.diff(arrivals["arrival_us"]) < 0).any():
        raise BufgymError("arrival times must be >= 0 and must not decrease")
    if arrivals["size_bytes"].min() < 1:
        raise BufgymError(f"message size {arrivals['size_bytes'].min()} bytes: must be >= 1")
    if not np.isfinite(arrivals["x"]).all() or (np.diff(arrivals["x"]) < 0).any():
        raise BufgymError("coordinates x must be finite numbers and must not decrease")
    return arrivals


def unchecked_messages(
    arrival_us: NDArray[np.int64], size_bytes: NDArray[np.int64] | int, x: NDArray[np.float64] | None
) -> NDArray[Any]:
    """``messages`` for columns that are known to keep the rules."""
    arrivals = records(len(arrival_us), MESSAGE)
    arrivals["seq"] = np.arange(len(arrival_us))
    arrivals["arrival_us"], arrivals["size_bytes"] = arrival_us, size_bytes
    arrivals["x"] = arrivals["seq"] if x is None else x
    return arrivals

"""An ``Episode``, drawn by a scenario from separate random streams."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bufgym.model.checks import check_window, whole
from bufgym.model.link import FOREVER, MAX_TIME_US, Link
from bufgym.model.qoi import Value
from bufgym.model.topics import MAX_ACK_DELAY_US, Topic
from bufgym.scenario.arrivals import check_messages, read_only, sealed
from bufgym.utils.errors import BufgymError

_MAX_SEEN = 10**7  # Messages times their consumers; more would not fit into memory


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


WORDS = (
    "arrivals", "first_decision", "last_decision", "window", "ack_delay_us", "ends_us", "offset_us", "propagation_us",
)  # fmt: skip
"""Fields of ``bufgym.sim.state.SENDER`` that an episode gives, in the order of ``Episode.words``."""


@dataclass(frozen=True, eq=False)
class Episode:
    """One drawn episode, checked when it is made; nothing in it is random any more.

    Raises:
        BufgymError: a message breaks a rule (see ``bufgym.scenario.arrivals``), another parameter is out of its range,
            or times or bytes on this link would not stay within 64 bits.
    """

    arrivals: NDArray[Any]
    """MESSAGE[n], read-only, in order of arrival; ``arrival_us`` never falls, nor does x on any topic."""
    link: Link
    """The link that carries the messages: a capacity trace and the episode's offset on it."""
    first_decision: int = 0
    """Sequence number of the first arrival that a policy decides on; earlier ones are accepted."""
    last_decision: int = 2**31
    """Sequence number of the last arrival that a policy decides on; later ones are accepted."""
    window: int = 1
    """n_T: most messages in flight, sent and not yet acked."""
    ack_delay_us: int = 0
    """Time from a message's last byte on the link to its ack, us; 0 if the sender does not wait for acks."""
    encodings: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    """int64[n], bytes of the messages in other encodings, by name; sizes stay the same in a missing one."""
    consumers: int = 1
    """Receivers of each message, and copies that a copying client sends."""
    value: Value | None = None
    """V for the episode's QoI; None for the scenario's."""
    ends_us: int | None = None
    """Time at which the robot was told that its stream ends, us, right or wrong; None if it was not told."""
    one_scene: bool = field(init=False, repr=False)
    """Whether x never falls, even across topics: only then can all messages share one queue."""
    words: NDArray[np.int64] = field(init=False, repr=False)
    """int64[8]: the values of ``WORDS``."""

    def __post_init__(self) -> None:
        check_window(self.window)
        whole("ack_delay_us", self.ack_delay_us, 0, MAX_ACK_DELAY_US)
        check_link(self.link)
        arrivals = sealed(self.arrivals)
        total_bytes, rises = check_messages(arrivals)
        object.__setattr__(self, "arrivals", arrivals)
        object.__setattr__(self, "one_scene", rises)
        n = len(arrivals)
        whole("first_decision", self.first_decision)
        whole("last_decision", self.last_decision, 0, 2**62)
        whole("consumers", self.consumers, 1, max(1, _MAX_SEEN // n))
        check_end(self.ends_us)
        for name, size_bytes in self.encodings.items():
            if np.shape(size_bytes) != (n,):
                raise BufgymError(f"encodings[{name!r}]: must be int64[{n}], the bytes of each message")
        pauses = n if self.ack_delay_us else 0
        self.link.check_reach(int(arrivals["arrival_us"][-1]), total_bytes, pauses, self.ack_delay_us)
        ends_us = FOREVER if self.ends_us is None else self.ends_us
        given = {**vars(self), **vars(self.link), "arrivals": n, "ends_us": ends_us}
        object.__setattr__(self, "words", np.array([given[name] for name in WORDS], np.int64))

    def check_one_queue(self) -> None:
        """Raise unless one queue without topics can hold the messages: x must not fall from one to the next."""
        if not self.one_scene:
            raise BufgymError(
                "episode: x falls from one message to the next, as each topic has its own: not for one queue"
            )

    def valued(self, value: Value) -> Episode:
        """The same episode with a V of its own."""
        episode = copy.copy(self)  # all checked fields stay the same
        object.__setattr__(episode, "value", value)
        return episode

    def with_uniforms(self, rng: np.random.Generator) -> Episode:
        """The same episode with a fresh uniform draw beside each arrival, for randomised policies.

        ``Scenario.draw`` leaves these draws at 0, as an agent in an environment has randomness of its own. If a policy
        plays there, ``Senders.draw_uniforms`` adds them.
        """
        arrivals = self.arrivals.copy()
        arrivals["uniform"] = rng.random(len(arrivals))
        return replace(self, arrivals=read_only(arrivals))

    def encoded(self, encoding: str) -> Episode:
        """The same messages in another encoding."""
        if encoding not in self.encodings:
            return self
        arrivals = self.arrivals.copy()
        arrivals["size_bytes"] = self.encodings[encoding]
        return replace(self, arrivals=read_only(arrivals))

    def copied(self, topics: int) -> Episode:
        """One copy of each message for each consumer: copy c of topic t is on topic c x ``topics`` + t."""
        n = len(self.arrivals)
        arrivals = np.repeat(self.arrivals, self.consumers).view(type(self.arrivals))
        arrivals["topic"] += topics * np.tile(np.arange(self.consumers), n)
        arrivals["seq"] = np.arange(len(arrivals))
        encodings = {name: np.repeat(sizes, self.consumers) for name, sizes in self.encodings.items()}
        return replace(self, arrivals=read_only(arrivals), encodings=encodings, consumers=1)


def check_end(ends_us: Any) -> None:
    """Raise unless this is a time, us, or None."""
    if ends_us is not None:
        whole("ends_us", ends_us, 0, MAX_TIME_US)


def check_link(link: Any) -> Link:
    """Check that this is a link, and return it."""
    if not isinstance(link, Link):
        raise BufgymError(f"link: {link!r} is not a bufgym.model.link Link")
    return link


class Scenario(Protocol):
    """A family of episodes, frozen; all that derives from its parameters is computed from them."""

    @property
    def value(self) -> Value:
        """V for the QoI."""

    @property
    def max_messages(self) -> int:
        """Most arrivals of any episode."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The rules of its topics; empty for one queue."""

    def draw(self, streams: Streams) -> Episode:
        """Draw one episode."""

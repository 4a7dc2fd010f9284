"""One interruption of unknown length: the model of the AFR paper [wang2022afr]."""

import functools
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bufgym.model import qoi
from bufgym.model.checks import above_0, whole
from bufgym.model.link import MAX_TIME_US, Link
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.scenario.arrivals import messages, read_only
from bufgym.scenario.checks import check_sizes, check_value, rate, up_to
from bufgym.scenario.draws import SIZES, derived_generator
from bufgym.scenario.episode import Episode, Streams
from bufgym.traces import Trace
from bufgym.traces.generate.sizes import EQUAL, drawn
from bufgym.traces.workload import MAX_MESSAGE_BYTES
from bufgym.utils.errors import BufgymError

LAWS = ("fixed", "uniform", "log-uniform", "geometric")


@dataclass(frozen=True)
class Interruption:
    """One interruption of unknown length (AFR paper, Sec. III-B).

    Message 0 is in transmission when the link stops. The policy decides on messages 1..T, which arrive one a period.
    Then the link resumes, and all kept messages are delivered, with message T + 1 last. T is hidden and drawn from
    ``law``: ``fixed`` (t_max), ``uniform``, ``log-uniform`` or, with mean ``t_mean``, ``geometric`` on t_min..t_max.
    """

    law: str = "log-uniform"
    """Law of T, one of ``LAWS``."""
    t_min: int = 1
    """Shortest T, messages; not used by ``fixed``."""
    t_max: int = 400
    """Longest T, messages."""
    t_mean: float = 100.0
    """Mean T of ``geometric``, messages, before it is cut off."""
    rate_hz: float = 30.0
    """Messages a second."""
    size_bytes: int = 230_000
    """Mean bytes of a message."""
    sizes: str = EQUAL
    """Law of the sizes (``bufgym.traces.generate.sizes``), of mean ``size_bytes``."""
    value: Value = field(default_factory=qoi.exponential)
    """V for the QoI."""
    lengths: tuple[int, ...] = ()
    """Allowed T, if any are given: T is drawn again until it is one of them."""

    topics: ClassVar[tuple[Topic, ...]] = ()
    """Empty: one queue."""
    """Factor on rewards that brings a default episode's return between 1 and 10."""

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise BufgymError(f"law = {self.law!r}: must be one of {', '.join(LAWS)}")
        for name in ("t_min", "t_max", "size_bytes"):
            object.__setattr__(self, name, whole(name, getattr(self, name)))
        if not 1 <= self.t_max <= 10**6:
            raise BufgymError(f"t_max = {self.t_max}: must lie between 1 and 1000000")
        if self.law != "fixed" and not 1 <= self.t_min <= self.t_max:
            raise BufgymError(f"t_min = {self.t_min}, t_max = {self.t_max}: need 1 <= t_min <= t_max <= 1000000")
        up_to("size_bytes", self.size_bytes, MAX_MESSAGE_BYTES)
        above_0("t_mean", self.t_mean)
        rate(self.rate_hz)
        if self.period_us * self.max_messages > MAX_TIME_US:
            raise BufgymError(
                f"t_max = {self.t_max} messages at rate_hz = {self.rate_hz}: must arrive within {MAX_TIME_US} us"
            )
        if self.law == "geometric" and not self.t_mean >= self.t_min:
            raise BufgymError(f"t_mean = {self.t_mean}: must be at least t_min = {self.t_min}")
        check_value(self)
        check_sizes(self, False)
        object.__setattr__(self, "lengths", tuple(whole("lengths", T) for T in self.lengths))
        shortest = self.t_max if self.law == "fixed" else self.t_min
        if self.lengths and not any(shortest <= T <= self.t_max for T in self._allowed):
            raise BufgymError(f"lengths = {self.lengths}: none lies between {shortest} and t_max = {self.t_max}")

    @functools.cached_property
    def _allowed(self) -> frozenset[int]:
        return frozenset(self.lengths)

    @property
    def about(self) -> str:
        """The law of T, and V."""
        length = f"T = {self.t_max}" if self.law == "fixed" else f"T {self.law} on {self.t_min}..{self.t_max}"
        return f"One interruption of T messages, {length}; V = {self.value.name} over frame indices."

    @property
    def max_messages(self) -> int:
        """Arrivals of the longest episode."""
        return self.t_max + 2

    @property
    def period_us(self) -> int:
        """Time between arrivals, us."""
        return round(1e6 / self.rate_hz)

    def draw_length(self, rng: np.random.Generator) -> int:
        """T, messages."""
        T = self._draw_once(rng)
        while self.lengths and T not in self._allowed:
            T = self._draw_once(rng)
        return T

    def _draw_once(self, rng: np.random.Generator) -> int:
        if self.law == "fixed":
            return self.t_max
        if self.law == "uniform":
            return int(rng.integers(self.t_min, self.t_max, endpoint=True))
        if self.law == "log-uniform":
            # Real-valued on [t_min, t_max + 1), so that every T has weight ln((T + 1) / T).
            return min(self.t_max, int(self.t_min * ((self.t_max + 1) / self.t_min) ** rng.random()))
        return min(self.t_max, self.t_min - 1 + int(rng.geometric(1 / (self.t_mean - self.t_min + 1))))

    def episode(self, T: int) -> Episode:
        """The interruption of exactly T messages, 1 <= T <= t_max, all of ``size_bytes``."""
        if (known := self._episodes.get(T)) is not None:
            return known
        if not 1 <= T <= self.t_max:
            raise BufgymError(f"T = {T}: must lie between 1 and t_max = {self.t_max}")
        self._episodes[T] = self._over_a_blocked_link(self._table[: T + 2], T, self.max_messages * self.size_bytes)
        return self._episodes[T]

    def _over_a_blocked_link(self, arrivals: NDArray[Any], T: int, total_bytes: int) -> Episode:
        resumes_us = self.period_us * T + self.period_us // 2
        trace = _blocked_then_open(self.period_us * (self.t_max + 1), total_bytes)
        return Episode(arrivals, Link(trace, offset_us=int(trace.time_us[1]) - resumes_us), 1, T)

    def draw(self, streams: Streams) -> Episode:
        """Draw one episode."""
        T = self.draw_length(streams.link)
        if self.sizes == EQUAL:
            return self.episode(T)
        arrivals = self._table[: T + 2].copy()
        arrivals["size_bytes"] = drawn(self.sizes, T + 2, self.size_bytes, derived_generator(streams.arrival, SIZES))
        return self._over_a_blocked_link(read_only(arrivals), T, int(arrivals["size_bytes"].sum()))

    @functools.cached_property
    def _episodes(self) -> dict[int, Episode]:
        """Episodes used so far, by length. They differ only in length, so each is made once."""
        return {}

    @functools.cached_property
    def _table(self) -> NDArray[Any]:
        """MESSAGE[t_max + 2]: every episode is a prefix of this table."""
        arrivals = messages(np.arange(self.max_messages, dtype=np.int64) * self.period_us, int(self.size_bytes))
        return read_only(arrivals)


@functools.lru_cache(maxsize=64)
def _blocked_then_open(blocked_us: int, total_bytes: int) -> Trace:
    """Nothing for ``blocked_us``, then ``total_bytes`` in one microsecond, again and again."""
    knots_us, carried = np.array([0, blocked_us, blocked_us + 1], np.int64), np.array([0, 0, total_bytes], np.int64)
    return Trace("interruption", knots_us, carried, after="hold")

"""Scenarios: what meets the sender. All randomness is drawn here, before the simulation, which has none.

``Scenario.draw(streams) -> Episode`` draws one episode: when messages arrive, how large they are, how far the scene
moves, which link carries them. Arrivals, link and policy luck come from separate streams, so that two policies (or
two policy seeds) meet the very same episode: common random numbers.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bufgym import qoi, traces
from bufgym.buffer import MESSAGE
from bufgym.errors import BufgymError
from bufgym.kernel import records
from bufgym.link import Link
from bufgym.qoi import Value
from bufgym.traces import Motion, Trace
from bufgym.traces.workload import Workload


class Streams(NamedTuple):
    """One random generator for each source of chance."""

    arrival: np.random.Generator
    link: np.random.Generator
    policy: np.random.Generator

    @staticmethod
    def seeded(seed: int | np.random.SeedSequence) -> Streams:
        """Three independent streams from one seed."""
        root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(_natural("seed", seed))
        return Streams(*(np.random.Generator(np.random.PCG64(child)) for child in root.spawn(3)))


@dataclass(frozen=True, eq=False)
class Episode:
    """One drawn episode; nothing in it is left to chance."""

    arrivals: NDArray[Any]
    """MESSAGE[n], in order of arrival (``arrival_us`` non-decreasing from 0, x non-decreasing)."""
    link: Link
    first_decision: int = 0
    """Arrivals before this one are sent without asking a policy."""
    last_decision: int = 2**31
    """Arrivals after this one, likewise."""
    window: int = 1
    """n_T: messages in flight (sent, and not yet answered by a pong) at most."""
    pong_us: int = 0
    """From the moment when a message's last byte has crossed to its pong, us; 0: nobody waits for pongs."""

    # Luck is not drawn with the rest: an agent in an environment has chance of its own.

    def with_luck(self, rng: np.random.Generator) -> Episode:
        """The same episode with fresh luck for randomised policies."""
        arrivals = self.arrivals.copy()
        arrivals["luck"] = rng.random(len(arrivals))
        return replace(self, arrivals=arrivals)


class Scenario(Protocol):
    """A family of episodes. Frozen: what derives from its parameters is computed, never stored."""

    @property
    def value(self) -> Value:
        """The V that its QoI is measured with."""

    @property
    def max_messages(self) -> int:
        """No episode has more arrivals than this."""

    def draw(self, streams: Streams) -> Episode:
        """One episode."""


def messages(
    arrival_us: NDArray[np.int64], size_bytes: NDArray[np.int64] | int, x: NDArray[np.float64] | None = None
) -> NDArray[Any]:
    """MESSAGE[n] from columns; x defaults to the frame index. Times and x must not decrease, sizes be >= 1 byte."""
    made = _messages(arrival_us, size_bytes, x)
    if len(made) == 0:
        raise BufgymError("an episode needs at least one message")
    if made["arrival_us"][0] < 0 or (np.diff(made["arrival_us"]) < 0).any():
        raise BufgymError("arrival times must be >= 0 and must not decrease")
    if made["size_bytes"].min() < 1:
        raise BufgymError(f"message size {made['size_bytes'].min()} bytes: must be >= 1")
    if not np.isfinite(made["x"]).all() or (np.diff(made["x"]) < 0).any():
        raise BufgymError("coordinates x must be finite numbers and must not decrease")
    return made


def _messages(
    arrival_us: NDArray[np.int64], size_bytes: NDArray[np.int64] | int, x: NDArray[np.float64] | None
) -> NDArray[Any]:
    made = records(len(arrival_us), MESSAGE)
    made["seq"] = np.arange(len(arrival_us))
    made["arrival_us"], made["size_bytes"] = arrival_us, size_bytes
    made["x"] = made["seq"] if x is None else x
    return made


# --- one interruption ------------------------------------------------------------------------------------------------

MAX_RATE_HZ = 100_000
"""Arrivals are counted in whole microseconds: ten to a period at least."""

LAWS = ("fixed", "uniform", "log-uniform", "geometric")


@dataclass(frozen=True)
class Interruption:
    """One interruption of unknown length (AFR paper, Sec. III-B).

    Message 0 is in transmission when the link stops; messages 1..T arrive, one a period, and meet the policy; then the
    link resumes, all that is kept is delivered, and message T + 1 after it. T is hidden and drawn from ``law``:
    ``fixed`` (t_max), ``uniform`` or ``log-uniform`` on t_min..t_max, ``geometric`` from t_min on with mean
    ``t_mean``, cut off at t_max.
    """

    law: str = "log-uniform"
    t_min: int = 1
    t_max: int = 400
    t_mean: float = 100.0
    rate_hz: float = 30.0
    size_bytes: int = 230_000
    value: Value = field(default_factory=qoi.exponential)
    lengths: tuple[int, ...] = ()
    """If any are given: T is drawn again until it is one of these."""

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise BufgymError(f"law = {self.law!r}: must be one of {', '.join(LAWS)}")
        for name in ("t_min", "t_max", "size_bytes"):
            object.__setattr__(self, name, _natural(name, getattr(self, name)))
        if not 1 <= self.t_min <= self.t_max <= 10**6:
            raise BufgymError(f"t_min = {self.t_min}, t_max = {self.t_max}: need 1 <= t_min <= t_max <= 1000000")
        _positive(self, "size_bytes", "t_mean")
        _rate(self.rate_hz)
        if not self.t_mean >= self.t_min:
            raise BufgymError(f"t_mean = {self.t_mean}: must be at least t_min = {self.t_min}")
        _value(self)
        object.__setattr__(self, "lengths", tuple(_natural("lengths", T) for T in self.lengths))
        shortest = self.t_max if self.law == "fixed" else self.t_min
        if self.lengths and not any(shortest <= T <= self.t_max for T in self._allowed):
            raise BufgymError(f"lengths = {self.lengths}: none lies between {shortest} and t_max = {self.t_max}")

    @functools.cached_property
    def _allowed(self) -> frozenset[int]:
        return frozenset(self.lengths)

    @property
    def max_messages(self) -> int:
        return self.t_max + 2

    @property
    def period_us(self) -> int:
        """Time between arrivals, us."""
        return round(1e6 / self.rate_hz)

    def draw_length(self, rng: np.random.Generator) -> int:
        """T, messages."""
        while True:
            T = self._drawn_length(rng)
            if not self.lengths or T in self._allowed:
                return T

    def _drawn_length(self, rng: np.random.Generator) -> int:
        if self.law == "fixed":
            return self.t_max
        if self.law == "uniform":
            return int(rng.integers(self.t_min, self.t_max, endpoint=True))
        if self.law == "log-uniform":
            # Real-valued on [t_min, t_max + 1), so that every T has weight ln((T + 1) / T).
            return min(self.t_max, int(self.t_min * ((self.t_max + 1) / self.t_min) ** rng.random()))
        return min(self.t_max, self.t_min - 1 + int(rng.geometric(1 / (self.t_mean - self.t_min + 1))))

    def episode(self, T: int) -> Episode:
        """The interruption of exactly T messages, 1 <= T <= t_max."""
        if not 1 <= T <= self.t_max:
            raise BufgymError(f"T = {T}: must lie between 1 and t_max = {self.t_max}")
        if T not in self._episodes:
            resumes_us = self.period_us * T + self.period_us // 2
            trace = _blocked_then_open(self.period_us * (self.t_max + 1), self.max_messages * self.size_bytes)
            link = Link(trace, offset_us=int(trace.time_us[1]) - resumes_us)
            self._episodes[T] = Episode(self._table[: T + 2], link, 1, T)
        return self._episodes[T]

    def draw(self, streams: Streams) -> Episode:
        return self.episode(self.draw_length(streams.link))

    @functools.cached_property
    def _episodes(self) -> dict[int, Episode]:
        """Those drawn so far: the length is all that differs, so each is made once."""
        return {}

    @functools.cached_property
    def _table(self) -> NDArray[Any]:
        """Messages 0..t_max + 1: every episode is a beginning of this table."""
        return messages(np.arange(self.max_messages, dtype=np.int64) * self.period_us, int(self.size_bytes))


@functools.lru_cache(maxsize=64)
def _blocked_then_open(blocked_us: int, total_bytes: int) -> Trace:
    """Nothing for ``blocked_us``, then ``total_bytes`` in one microsecond, again and again."""
    return Trace(
        "interruption",
        np.array([0, blocked_us, blocked_us + 1], np.int64),
        np.array([0, 0, total_bytes], np.int64),
        after="hold",
    )


# --- a stream over a real or synthetic link --------------------------------------------------------------------------


@dataclass(frozen=True)
class Uplink:
    """A camera stream over capacity traces.

    Frames arrive at ``rate_hz``, each moved within its period by up to ``jitter`` of it; sizes are log-normal with
    mean ``size_bytes`` and coefficient of variation ``size_cv`` (0: all equal). The link is one of ``traces``, chosen
    at random, times ``scale`` (one of them at random where several are given), from a random offset on. ``motion``:
    recordings that give x, from a random offset on; without one, x is the frame index.

    ``workload``: a robot's recording, played as it is, in place of the stream that ``rate_hz``, ``jitter``,
    ``size_bytes``, ``size_cv`` and ``duration_s`` describe. All its topics share the queue; it gives x if it has one.
    """

    traces: tuple[Trace, ...] = ()
    motion: tuple[Motion, ...] = ()
    rate_hz: float = 30.0
    jitter: float = 0.1
    size_bytes: int = 230_000
    size_cv: float = 0.0
    duration_s: float = 30.0
    scale: tuple[float, ...] = (1.0,)
    random_offset: bool = True
    link_offset_s: tuple[float, float] | None = None
    """Where on the trace an episode begins, at random from..to, s; None: anywhere."""
    propagation_us: int = 20_000
    value: Value = field(default_factory=lambda: qoi.exponential(math.exp(-1)))
    workload: Workload | None = None

    def __post_init__(self) -> None:
        for name, kind, what in (
            ("traces", Trace, "a bufgym.traces Trace"),
            ("motion", Motion, "a bufgym.traces Motion"),
            ("scale", int | float, "a number > 0"),
        ):
            given = getattr(self, name)
            if isinstance(given, str) or not isinstance(given, Sequence):
                given = (given,)
            for item in given:
                if not isinstance(item, kind):
                    raise BufgymError(f"{name}: {item!r} is not {what}")
            object.__setattr__(self, name, tuple(given))
        if not self.traces:
            raise BufgymError("traces: an uplink needs at least one bandwidth trace")
        if not self.scale or not all(math.isfinite(s) and s > 0 for s in self.scale):
            raise BufgymError(f"scale = {self.scale}: every factor must be a number > 0")
        _positive(self, "size_bytes", "duration_s")
        _rate(self.rate_hz)
        _natural("propagation_us", self.propagation_us)
        if self.size_bytes < 1:
            raise BufgymError(f"size_bytes = {self.size_bytes}: must be at least 1")
        for name in ("jitter", "size_cv"):
            if not _is_number(getattr(self, name)):
                raise BufgymError(f"{name} = {getattr(self, name)!r}: must be a number")
        if not 0 <= self.jitter <= 1:
            raise BufgymError(f"jitter = {self.jitter}: must lie between 0 and 1 (of a period)")
        if not 0 <= self.size_cv <= 10:
            raise BufgymError(f"size_cv = {self.size_cv}: must lie between 0 and 10")
        if self.link_offset_s is not None and not (
            len(self.link_offset_s) == 2 and 0 <= self.link_offset_s[0] <= self.link_offset_s[1] < math.inf
        ):
            raise BufgymError(f"link_offset_s = {self.link_offset_s}: must be (from, to) with 0 <= from <= to, s")
        if self.workload is not None and not isinstance(self.workload, Workload):
            raise BufgymError(f"workload: {self.workload!r} is not a bufgym.traces Workload")
        if self.workload is not None and self.workload.x is not None and self.motion:
            raise BufgymError(f"motion: workload {self.workload.name!r} has an x of its own")
        if not 1 <= self.max_messages <= 10**7:
            raise BufgymError(f"rate_hz x duration_s = {self.max_messages} messages: must lie between 1 and 10000000")
        _value(self)

    @property
    def max_messages(self) -> int:
        return round(self.rate_hz * self.duration_s) if self.workload is None else len(self.workload)

    @functools.cached_property
    def _links(self) -> tuple[Trace, ...]:
        return tuple(trace if s == 1 else trace.scaled(s) for trace in self.traces for s in self.scale)

    def draw(self, streams: Streams) -> Episode:
        arrivals = self._stream(streams.arrival) if self.workload is None else _replayed(self.workload)
        if self.motion:
            motion = self.motion[int(streams.arrival.integers(len(self.motion)))]
            start = int(streams.arrival.integers(motion.time_us[-1])) if self.random_offset else 0
            x = motion.at(arrivals["arrival_us"] + start)
            arrivals["x"] = x - x[0]
        trace = self._links[int(streams.link.integers(len(self._links)))]
        offset = 0
        if self.random_offset:
            first, last = self.link_offset_s or (0.0, trace.duration_us / 1e6)
            offset = int(streams.link.integers(round(first * 1e6), max(round(last * 1e6), 1 + round(first * 1e6))))
        return Episode(arrivals, Link(trace, offset, int(self.propagation_us)))

    def _stream(self, rng: np.random.Generator) -> NDArray[Any]:
        """MESSAGE[n] of the camera, x being the frame index."""
        n, period_us = self.max_messages, 1e6 / self.rate_hz
        moved = np.arange(n, dtype=np.float64)
        if self.jitter:
            moved += self.jitter * rng.random(n)
        arrival_us = (moved * period_us).astype(np.int64)
        arrival_us -= arrival_us[0]
        size: NDArray[np.int64] | int = int(self.size_bytes)
        if self.size_cv:
            spread = math.sqrt(math.log1p(self.size_cv**2))
            drawn = self.size_bytes * np.exp(spread * rng.standard_normal(n) - spread**2 / 2)
            size = np.maximum(1, np.rint(drawn)).astype(np.int64)
        return _messages(arrival_us, size, None)


def _replayed(workload: Workload) -> NDArray[Any]:
    """MESSAGE[n] of a recording."""
    arrivals = _messages(workload.arrival_us, workload.size_bytes, workload.x)
    arrivals["topic"] = workload.topic
    return arrivals


# --- scenarios by name -----------------------------------------------------------------------------------------------


def _lte() -> Uplink:
    names = traces.shipped()
    return Uplink(
        traces=tuple(traces.load(name) for name in names if name.startswith("lte-")),
        motion=tuple(traces.load_motion(name) for name in names if name.startswith("drive-")),
    )


SCENARIOS: dict[str, tuple[Callable[[], Scenario], str]] = {
    "interruption": (Interruption, "one interruption of unknown length (AFR paper, Sec. III-B)"),
    "lte": (_lte, "30 Hz camera on a driving robot over the shipped synthetic LTE traces"),
}


@functools.cache
def _named(name: str) -> Scenario:
    return SCENARIOS[name][0]()


def get(spec: str | Scenario, **overrides: Any) -> Scenario:
    """The scenario of that name (or the given one), with the given parameters changed."""
    if isinstance(spec, str):
        if spec not in SCENARIOS:
            raise BufgymError(f"unknown scenario {spec!r}; known: {', '.join(SCENARIOS)}")
        spec = _named(spec)
    if not overrides:
        return spec
    known = {f.name for f in fields(spec)}  # type: ignore[arg-type]
    for name in overrides:
        if name not in known:
            raise BufgymError(f"{type(spec).__name__}: no parameter {name!r}; it has: {', '.join(sorted(known))}")
    return replace(spec, **overrides)  # type: ignore[type-var]


def _positive(scenario: object, *names: str) -> None:
    for name in names:
        _above_0(name, getattr(scenario, name))


def _above_0(name: str, number: Any) -> None:
    if not (_is_number(number) and math.isfinite(number) and number > 0):
        raise BufgymError(f"{name} = {number!r}: must be a number > 0")


def _rate(rate_hz: Any) -> None:
    _above_0("rate_hz", rate_hz)
    if rate_hz > MAX_RATE_HZ:
        raise BufgymError(f"rate_hz = {rate_hz}: must be at most {MAX_RATE_HZ}")


def _is_number(given: Any) -> bool:
    return isinstance(given, int | float | np.number) and not isinstance(given, bool)


def _natural(name: str, number: Any) -> int:
    if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 0:
        raise BufgymError(f"{name} = {number!r}: must be a whole number >= 0")
    return int(number)


def _value(scenario: object) -> None:
    given = getattr(scenario, "value")  # noqa: B009  (both kinds of scenario have it)
    if not isinstance(given, Value):
        raise BufgymError(f"value = {given!r}: must be a bufgym.qoi Value, such as qoi.exponential(0.618)")

"""A link's capacity over time: how many bytes it could have carried since the trace began.

Model: cumulative bytes, piecewise linear between knots (the view of mahimahi's `link_queue`, with straight lines in
place of packets). Time is int64 microseconds and capacity int64 bytes, so that computations from a trace give the same
on every machine. For example, 1 MB/s for one second is the two knots (0, 0), (1_000_000, 1_000_000).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt

from bufgym.traces.sheet import NONE, Sheet
from bufgym.utils.errors import BufgymError

Int64Array = npt.NDArray[np.int64]
Float64Array = npt.NDArray[np.float64]
After = Literal["loop", "hold", "stop"]
Holes = Literal["hold", "zero", "refuse"]

US_PER_S: Final = 1_000_000

# Interpolating inside a segment computes (bytes x microseconds); below this limit it fits an int64 with a bit to spare.
PRODUCT_LIMIT: Final = 2**62

# Four months. A longer trace is a unit mistake (ns or ms read as s), not a recording.
MAX_DURATION_S: Final = 10**7

_MAX_ADDED_KNOTS: Final = 10**7

# Traces with knots closer than this (mahimahi: 1 ms) hold single packets; their rates are taken over whole seconds.
_FINE_SEGMENT_US: Final = 100_000


@dataclass(frozen=True, eq=False)
class Trace:
    """The capacity of a link, checked when it is made; its arrays are read-only.

    Raises:
        BufgymError: an array is not whole numbers (NaN included), too short, negative, out of order, or does not start
            at 0; a trace that loops has no capacity at all (a message would never leave).
    """

    name: str
    """What to call it in tables, for example "report_car_0002"."""
    time_us: Int64Array
    """int64[K], K >= 2, microseconds, strictly increasing from 0. Knots are added inside a segment in which
    (bytes x microseconds) >= 2**62, which integer interpolation could not hold."""
    cumulative_bytes: Int64Array
    """int64[K], bytes that the link could have carried by then, non-decreasing from 0; linear between knots."""
    after: After = "loop"
    """After the last knot: "loop" begins again, "hold" continues at the last segment's rate, "stop" carries nothing."""
    source: str = ""
    """Where it comes from, in words, with the file's format."""
    holes: tuple[tuple[int, int], ...] = ()
    """(start, end) in microseconds of stretches without a sample, each from a usual step after the last one on."""
    sheet: Sheet = NONE
    """Facts and doubts."""

    def __post_init__(self) -> None:
        time_us = _whole_numbers(self.time_us, "time_us")
        freeze(self, time_us=time_us, cumulative_bytes=_whole_numbers(self.cumulative_bytes, "cumulative_bytes"))
        self._check()
        self._add_knots()

    def _check(self) -> None:
        time_us, cumulative = self.time_us, self.cumulative_bytes
        if self.after not in get_args(After):
            raise self._broken(f"after = {self.after!r}: must be one of {', '.join(get_args(After))}")
        if time_us.size != cumulative.size:
            raise self._broken(f"{time_us.size} times for {cumulative.size} byte counts: must be as many")
        if time_us.size < 2:
            raise self._broken(f"{time_us.size} knots: must be at least 2")
        if time_us[0] != 0 or cumulative[0] != 0:
            raise self._broken(f"first knot ({time_us[0]} us, {cumulative[0]} bytes): must be (0, 0)")
        if (k := first_true(time_us[1:] <= time_us[:-1])) is not None:
            value, previous = time_us[k + 1], time_us[k]
            raise self._broken(f"time_us[{k + 1}] = {value} after {previous}: must increase at every knot")
        if (k := first_true(cumulative[1:] < cumulative[:-1])) is not None:
            value, previous = cumulative[k + 1], cumulative[k]
            raise self._broken(f"cumulative_bytes[{k + 1}] = {value} after {previous}: must not decrease")
        if self.duration_us >= PRODUCT_LIMIT or self.total_bytes >= PRODUCT_LIMIT:
            raise self._broken(f"ends at ({self.duration_us} us, {self.total_bytes} bytes): both must be below 2**62")
        if self.after == "loop" and self.total_bytes == 0:
            raise self._broken('no capacity at all: with after = "loop" a message would never leave')

    def _add_knots(self) -> None:
        """Cut each segment in which (bytes x microseconds) reaches PRODUCT_LIMIT into pieces of whole bytes."""
        lengths_us, counts = np.diff(self.time_us), np.diff(self.cumulative_bytes)
        large = np.flatnonzero(counts > (PRODUCT_LIMIT - 1) // lengths_us)
        places: list[int] = []
        times: list[int] = []
        sums: list[int] = []
        for k in large.tolist():
            # As Python's integers, which do not overflow.
            length, count = int(lengths_us[k]), int(counts[k])
            pieces = min(length, 2 * math.isqrt(length * count // PRODUCT_LIMIT) + 1)
            if len(times) + pieces > _MAX_ADDED_KNOTS:
                raise self._broken(f"segment {k} carries {count} bytes in {length} us: too much for one (add knots)")
            inner = [length * j // pieces for j in range(1, pieces)]
            places += [k + 1] * len(inner)
            times += [int(self.time_us[k]) + t for t in inner]
            sums += [int(self.cumulative_bytes[k]) + t * count // length for t in inner]
        if places:
            added = ((self.time_us, times), (self.cumulative_bytes, sums))
            time_us, cumulative = (np.insert(knots, places, np.array(new, np.int64)) for knots, new in added)
            freeze(self, time_us=time_us, cumulative_bytes=cumulative)

    def _broken(self, what: str) -> BufgymError:
        return BufgymError(f"trace {self.name!r}: {what}")

    def __eq__(self, other: object) -> bool:
        """Same name, same knots, same ending; `source` says only where they came from."""
        if not isinstance(other, Trace):
            return NotImplemented
        arrays = ((self.time_us, other.time_us), (self.cumulative_bytes, other.cumulative_bytes))
        return (self.name, self.after) == (other.name, other.after) and all(np.array_equal(*pair) for pair in arrays)

    def __hash__(self) -> int:
        return hash((self.name, self.after, self.time_us.size, self.duration_us, self.total_bytes))

    @functools.cached_property
    def duration_us(self) -> int:
        """Time of the last knot, microseconds."""
        return int(self.time_us[-1])

    @functools.cached_property
    def total_bytes(self) -> int:
        """Bytes that the link can carry from the first knot to the last."""
        return int(self.cumulative_bytes[-1])

    @property
    def mean_bytes_per_s(self) -> float:
        """Total bytes over duration."""
        return self.total_bytes * US_PER_S / self.duration_us

    def segments(self) -> tuple[Int64Array, Float64Array]:
        """Edges int64[K] in microseconds, float64[K-1] bytes/s between them: `plt.stairs(rate, edges)`."""
        return self.time_us, np.diff(self.cumulative_bytes) * float(US_PER_S) / np.diff(self.time_us)

    def rate_bytes_per_s(self, time_us: npt.ArrayLike) -> Float64Array:
        """Rate in bytes/s at each time (microseconds, any shape); at a knot, the rate of the segment that begins there.

        Beyond the last knot `after` decides: loop, hold, or 0.
        """
        times = np.asarray(time_us, dtype=np.int64)
        if (times < 0).any():
            raise self._broken(f"time_us = {times.min()}: must be >= 0")
        _, rates = self.segments()
        inside = times % self.duration_us if self.after == "loop" else np.minimum(times, self.duration_us - 1)
        rate = rates[np.searchsorted(self.time_us, inside, side="right") - 1]
        if self.after == "stop":
            rate = np.where(times >= self.duration_us, 0.0, rate)
        return np.asarray(rate, dtype=np.float64)

    def samples(self, window_us: int | None = None) -> tuple[Int64Array, Float64Array]:
        """The trace as measurements: lengths int64[n] in microseconds and mean rates float64[n] in bytes/s.

        Args:
            window_us: take means over consecutive windows of this length; an incomplete last one is left out unless it
                is the only one. By default the samples are the segments themselves, except for traces of single packets
                (median segment under 100 ms, as in mahimahi files), where they are windows of 1 s.
        """
        if window_us is None:
            lengths_us = np.diff(self.time_us)
            if np.median(lengths_us) >= _FINE_SEGMENT_US:
                return lengths_us, self.segments()[1]
            window_us = US_PER_S
        if window_us < 1:
            raise self._broken(f"window_us = {window_us}: must be >= 1")
        window_us = min(window_us, self.duration_us)
        edges_us = np.arange(0, self.duration_us + 1, window_us, dtype=np.int64)
        window_bytes = np.diff(np.interp(edges_us, self.time_us, self.cumulative_bytes))
        return np.diff(edges_us), window_bytes * (US_PER_S / window_us)

    def scaled(self, factor: float) -> Trace:
        """The same trace with every rate times `factor`; each cumulative count is rounded to a whole byte."""
        if not (math.isfinite(factor) and factor >= 0):
            raise self._broken(f"factor = {factor}: must be a finite number >= 0")
        if factor == 1:
            return self
        if self.total_bytes * factor >= PRODUCT_LIMIT:
            raise self._broken(f"factor = {factor}: the total of {self.total_bytes} bytes would pass 2**62")
        # Multiplying and rounding both preserve order, so the counts cannot start to decrease.
        cumulative = np.rint(self.cumulative_bytes * factor).astype(np.int64)
        return replace(self, cumulative_bytes=cumulative, source=f"{self.source} x {factor:g}".strip())

    def with_holes(self, how: Holes) -> Trace:
        """The trace with the rate before each hole held in it, or nothing sent."""
        time_us = np.union1d(self.time_us, np.array(self.holes, np.int64).ravel())
        cumulative = np.rint(np.interp(time_us, self.time_us, self.cumulative_bytes)).astype(np.int64)
        counts = cumulative[1:] - cumulative[:-1]
        for start_us, end_us in self.holes:
            first, last = np.searchsorted(time_us, [start_us, end_us])
            lengths_us = np.diff(time_us[first - 1 : last + 1])
            rate = 0.0 if how == "zero" else counts[first - 1] / lengths_us[0]
            counts[first:last] = np.rint(rate * lengths_us[1:])
        return replace(self, time_us=time_us, cumulative_bytes=_from_zero(counts))

    @classmethod
    def from_intervals(
        cls,
        interval_us: npt.ArrayLike,
        bytes_in_interval: npt.ArrayLike,
        *,
        name: str = "intervals",
        after: After = "loop",
        source: str = "",
    ) -> Trace:
        """A trace from measurements that follow each other without gaps.

        Args:
            interval_us: int64[K-1], length of each interval in microseconds, > 0.
            bytes_in_interval: int64[K-1], bytes transmitted in each, >= 0.
            name, after, source: as in ``Trace``.
        """
        lengths = _whole_numbers(interval_us, "interval_us")
        counts = _whole_numbers(bytes_in_interval, "bytes_in_interval")
        for what, values, least in (("interval_us", lengths, 1), ("bytes_in_interval", counts, 0)):
            if (k := first_true(values < least)) is not None:
                raise BufgymError(f"trace {name!r}: {what}[{k}] = {values[k]}: must be >= {least}")
            # A float sum cannot wrap around, as an int64 sum would.
            if values.sum(dtype=np.float64) >= PRODUCT_LIMIT:
                raise BufgymError(f"trace {name!r}: sum of {what}: must be below 2**62")
        return cls(name, _from_zero(lengths), _from_zero(counts), after, source)

    @classmethod
    def constant(cls, bytes_per_s: float, duration_s: float, *, name: str = "constant", after: After = "loop") -> Trace:
        """One rate throughout, with a knot every second."""
        return cls.steps([(duration_s, bytes_per_s)], name=name, after=after)

    @classmethod
    def steps(cls, steps: Iterable[tuple[float, float]], *, name: str = "steps", after: After = "loop") -> Trace:
        """Constant rates one after the other, each as (seconds, bytes/s), with a knot at least every second.

        `Trace.steps([(2, 7e6), (0.5, 0)])` is two good seconds and an outage of half a second. Durations are
        rounded to whole microseconds, and each knot's count to a whole byte.

        Raises:
            BufgymError: a rate below 0, a duration under 1 us, over 10**7 s in all, or a number not finite.
        """
        knot_us, knot_bytes = [np.zeros(1, np.int64)], [np.zeros(1, np.int64)]
        start_us = start_bytes = 0
        for i, (seconds, bytes_per_s) in enumerate(steps):
            if not (math.isfinite(seconds) and round(seconds * US_PER_S) >= 1):
                raise BufgymError(f"trace {name!r}: step {i} lasts {seconds} s: must be a finite number >= 1e-6")
            if not (math.isfinite(bytes_per_s) and bytes_per_s >= 0):
                raise BufgymError(f"trace {name!r}: step {i} has {bytes_per_s} bytes/s: must be a finite number >= 0")
            length_us = round(seconds * US_PER_S)
            if start_us + length_us > MAX_DURATION_S * US_PER_S:
                raise BufgymError(f"trace {name!r}: lasts beyond {MAX_DURATION_S} s with step {i}: must not")
            if start_bytes + seconds * bytes_per_s >= PRODUCT_LIMIT:
                raise BufgymError(f"trace {name!r}: total of bytes with step {i}: must be below 2**62")
            elapsed_us = np.append(np.arange(US_PER_S, length_us, US_PER_S, dtype=np.int64), length_us)
            knot_us.append(start_us + elapsed_us)
            knot_bytes.append(start_bytes + np.rint(elapsed_us * (bytes_per_s / US_PER_S)).astype(np.int64))
            start_us, start_bytes = int(knot_us[-1][-1]), int(knot_bytes[-1][-1])
        return cls(name, np.concatenate(knot_us), np.concatenate(knot_bytes), after, "made by rule")


def describe(trace: Trace) -> dict[str, float]:
    """A trace's statistics, by the definitions of common tables of bandwidth data sets. 1 KB = 1000 bytes.

    All are over `Trace.samples`, so for a trace of single packets they are over whole seconds:

    - `duration_s`: length of all samples;
    - `mean_KBps`: bytes over time;
    - `min_KBps`: least rate among samples at least half as long as the median one (a stray sample of some ms means
      little), `max_KBps`: greatest rate among all;
    - `seconds_below_500KBps`: length of the samples under 500 KB/s;
    - `longest_run_below_500KBps_s`: greatest length of such samples in a row.
    """
    lengths_us, rates = trace.samples()
    low = rates < 500_000.0
    # Cumulative low time, and its value where the current run began: their difference is the run's length so far.
    low_us = np.cumsum(np.where(low, lengths_us, 0))
    before_run = np.maximum.accumulate(np.where(low, 0, low_us))
    long_enough = lengths_us >= 0.5 * np.median(lengths_us)
    return {
        "duration_s": float(lengths_us.sum()) / US_PER_S,
        "mean_KBps": float(np.average(rates, weights=lengths_us)) / 1e3,
        "min_KBps": float(rates[long_enough].min()) / 1e3,
        "max_KBps": float(rates.max()) / 1e3,
        "seconds_below_500KBps": float(low_us[-1]) / US_PER_S,
        "longest_run_below_500KBps_s": float((low_us - before_run).max()) / US_PER_S,
    }


def _from_zero(values: Int64Array) -> Int64Array:
    """Cumulative sums of int64[n] as int64[n+1], beginning with 0."""
    sums = np.zeros(values.size + 1, np.int64)
    np.cumsum(values, out=sums[1:])
    return sums


def _whole_numbers(values: npt.ArrayLike, what: str) -> Int64Array:
    """`values` as an int64[n] that nobody else can write to, or a BufgymError that says why not."""
    numbers = np.asarray(values)
    if numbers.ndim != 1:
        raise BufgymError(f"{what} has {numbers.ndim} dimensions: must be a row of numbers")
    if numbers.dtype == np.int64 and numbers.base is None and not numbers.flags.writeable:
        return numbers  # read-only already, so that large traces are not copied
    kind = numbers.dtype.kind
    if kind not in "iuf" and numbers.size:
        raise BufgymError(f"{what} holds {numbers.dtype} values: must be whole numbers below 2**63")
    if kind == "f" and (k := first_true(~(np.isfinite(numbers) & (numbers == np.floor(numbers))))) is not None:
        raise BufgymError(f"{what}[{k}] = {numbers[k]}: must be a whole number")
    if kind in "uf" and numbers.size and (numbers.max() >= 2**63 or numbers.min() < -(2**63)):
        raise BufgymError(f"{what} reaches {numbers.max()}: must be below 2**63")
    return numbers.astype(np.int64, copy=True)


def first_true(flags: npt.NDArray[np.bool_]) -> int | None:
    """The first index of bool[n] at which it is True, None if there is none."""
    return int(np.argmax(flags)) if flags.any() else None


def freeze(owner: object, **arrays: npt.NDArray[Any]) -> None:
    """Make these arrays read-only and store them in the fields of a frozen dataclass."""
    for field, values in arrays.items():
        values.flags.writeable = False
        object.__setattr__(owner, field, values)

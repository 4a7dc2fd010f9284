"""Laws of message sizes, as text: how the bytes of the messages of one stream vary.

docs/guide/topics-and-sizes.md lists them. `jpeg:cv=0.3,rho=0.9` changes parameters: `rho` from one frame to the next
and `cv` of the slow part, `noise`, the coefficient of variation of the part drawn anew, and a law's own. Each law has
the asked mean in expectation: it is divided by its own mean, not by the drawn sequence's.
"""

import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from bufgym.traces.formats.faults import fault
from bufgym.traces.formats.text import open_text, split_cells
from bufgym.traces.generate.draws import ar1, checked
from bufgym.traces.motion import Motion
from bufgym.traces.trace import Float64Array, Int64Array
from bufgym.traces.workload import MAX_MESSAGE_BYTES
from bufgym.utils import files
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.settings import named_settings

EQUAL: Final = "equal"
FLOOR: Final = 0.1  # What a camera at rest sends, in `motion`, as if it moved at this part of its mean speed
WINDOW_US: Final = 100_000  # Time over which speed is taken, us: three frames at 30 Hz
IN_TURN: Final = {"rvl-jpeg": ("rvl", "jpeg90")}  # Recorded sequences that alternate between columns of the table


class Moving(NamedTuple):
    """The motion of a stream's messages."""

    motion: Motion  # the recording that gives x
    time_us: Int64Array  # int64[n], times of the messages on it


class Range(NamedTuple):
    """A parameter of a law."""

    default: float
    least: float
    most: float


Numbers: TypeAlias = Mapping[str, float]
Draw: TypeAlias = Callable[[int, np.random.Generator, Numbers, Moving | None], Float64Array]
_SLOW = {"rho": Range(0.97, 0, 0.9999), "cv": Range(0.4, 0, 10)}
_NOISE, _RATIO = {"noise": Range(0.15, 0, 10)}, {"ratio": Range(4, 0.01, 1000)}


def _gop(n: int, rng: np.random.Generator, p: Numbers, _: Moving | None) -> Float64Array:
    every = int(p["every"])
    whole = (np.arange(n) + rng.integers(every)) % every == 0
    size = np.where(whole, p["ratio"], _slow(n, rng, p)) * _noise(n, rng, p)
    return np.asarray(size * (every / (every - 1 + p["ratio"])), np.float64)


def _depth_colour(n: int, rng: np.random.Generator, p: Numbers, _: Moving | None) -> Float64Array:
    pair, is_colour = np.divmod(np.arange(n) + rng.integers(2), 2)
    size = np.where(is_colour, 1.0, p["ratio"]) * _slow(n // 2 + 1, rng, p)[pair] * _noise(n, rng, p)
    return np.asarray(size * (2 / (1 + p["ratio"])), np.float64)


def _motion(n: int, rng: np.random.Generator, p: Numbers, moving: Moving | None) -> Float64Array:
    if moving is None:
        raise BufgymError("sizes 'motion': needs a motion recording")
    motion, exponent = moving.motion, p["exponent"]
    return (FLOOR + speeds(*moving)) ** exponent / _mean_of_motion(motion, exponent) * _noise(n, rng, p)


LAWS: Final[Mapping[str, tuple[Draw, Mapping[str, Range]]]] = {
    EQUAL: (lambda n, rng, p, moving: np.ones(n), {}),
    "jpeg": (lambda n, rng, p, moving: _slow(n, rng, p) * _noise(n, rng, p), _SLOW | _NOISE),
    "gop": (_gop, {"every": Range(30, 1, 10_000)} | _RATIO | _SLOW | {"rho": Range(0.9, 0, 0.9999)} | _NOISE),
    "depth-colour": (_depth_colour, _RATIO | _SLOW | {"noise": Range(0.05, 0, 10)}),
    "motion": (_motion, {"exponent": Range(0.3, -3, 3)} | _NOISE),
}
"""Name -> (function that draws sizes of mean 1, the law's parameters)."""


def drawn(text: str, n: int, mean_bytes: float, rng: np.random.Generator, moving: Moving | None = None) -> Int64Array:
    """Draw int64[n] sizes, bytes, at least 1; `motion` needs `moving`."""
    name, numbers, recorded = parsed(text)
    if recorded:
        sequence = recorded_sizes(recorded)
        relative = sequence[(rng.integers(len(sequence)) + np.arange(n)) % len(sequence)] / sequence.mean()
    else:
        relative = LAWS[name][0](n, rng, numbers, moving)
    size: Int64Array = np.clip(np.rint(mean_bytes * relative), 1, MAX_MESSAGE_BYTES).astype(np.int64)
    return size


@functools.lru_cache(maxsize=256)
def parsed(text: str) -> tuple[str, Numbers, str]:
    """Read text: (law, its parameters, name of the recorded sequence or "").

    Raises:
        BufgymError: an unknown law, parameter or sequence, or a number out of its range.
    """
    if not isinstance(text, str):
        raise BufgymError(f"sizes = {text!r}: must be text, such as 'jpeg' or 'jpeg:cv=0.3'")
    name, _, rest = text.partition(":")
    if name == "recorded":
        recorded_sizes(rest)
        return name, {}, rest
    if name not in LAWS:
        raise unknown("sizes", name, [*LAWS, "recorded"], ":NAME")
    ranges = LAWS[name][1]
    given = named_settings("sizes", text)[1]
    for key, number in given.items():
        if key not in ranges:
            none = BufgymError(f"sizes {text!r}: {name!r} has no parameters")
            raise unknown(f"parameter of sizes {name!r}", key, ranges) if ranges else none
        checked(f"sizes {text!r}: {key}", number, ranges[key].least, ranges[key].most)
    numbers = {key: known.default for key, known in ranges.items()} | given
    if numbers.get("every", 1) % 1:
        raise BufgymError(f"sizes {text!r}: every = {numbers['every']:g}: must be a whole number")
    return name, numbers, ""


def speeds(motion: Motion, time_us: Int64Array) -> Float64Array:
    """Speed over the last `WINDOW_US` before each time on a recording, over its mean; 1 where nothing ever moves."""
    if not motion.total:
        return np.ones(len(time_us))
    later = time_us + motion.duration_us * -(-WINDOW_US // motion.duration_us)  # so that no time lies before the start
    moved = motion.at(later) - motion.at(later - WINDOW_US)
    return np.asarray(np.maximum(0, moved) / (motion.total * WINDOW_US / motion.duration_us), np.float64)


@functools.lru_cache(maxsize=256)
def _mean_of_motion(motion: Motion, exponent: float) -> float:
    times = np.arange(0, motion.duration_us, WINDOW_US // 2, dtype=np.int64)
    return float(((FLOOR + speeds(motion, times)) ** exponent).mean())


def _slow(n: int, rng: np.random.Generator, p: Numbers) -> Float64Array:
    """A log-normal AR(1) process of mean 1."""
    return lognormal(np.array(ar1(rng.standard_normal(n).tolist(), p["rho"])), p["cv"])


def _noise(n: int, rng: np.random.Generator, p: Numbers) -> Float64Array:
    return lognormal(rng.standard_normal(n), p["noise"])


def lognormal(normal: Float64Array, cv: float) -> Float64Array:
    """Log-normal numbers of mean 1 and coefficient of variation `cv`, of standard normal ones."""
    spread = math.sqrt(math.log1p(cv**2))
    return np.asarray(np.exp(spread * normal - spread**2 / 2), np.float64)


def recorded() -> list[str]:
    """Names of the shipped sequences."""
    found = []
    for table, path in _tables().items():
        columns = read_sizes(path)
        turns = [name for name, parts in IN_TURN.items() if set(parts) <= set(columns)]
        found += [f"{table}-{name}" for name in [*columns, *turns] if name != "motion"]
    return found


@functools.lru_cache(maxsize=64)
def recorded_sizes(name: str) -> Int64Array:
    """int64[m], a shipped sequence, bytes."""
    table, _, column = name.partition("-")
    columns = read_sizes(_tables()[table]) if table in _tables() else {}
    parts = IN_TURN.get(column, (column,))
    if column == "motion" or not set(parts) <= set(columns):
        raise unknown("recorded sizes", name, recorded())
    return np.stack([columns[part] for part in parts], 1).ravel()


def read_sizes(path: Path) -> dict[str, Int64Array]:
    """Column -> int64[m] of a table of whole numbers with a header; `motion` is x in millionths of a view."""
    with open_text(path) as file:
        header, lines = file.below_header("a header that names its columns", bool)
        titles = split_cells(header.text)
        rows = [
            [line.whole(title, cell, MAX_MESSAGE_BYTES) for title, cell in zip(titles, cells, strict=True)]
            for line in lines
            for cells in [line.columns(len(titles), ",")]
        ]
    if not rows:
        raise fault(path, "holds no sizes: must hold at least one line below its header")
    return dict(zip(titles, np.array(rows, np.int64).T, strict=True))


def _tables() -> dict[str, Path]:
    return files.shipped("traces/sizes", "traces/sizes", "*.csv")

"""Draws that uplinks and clients share: shipped recordings, places on them, and message sizes."""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from bufgym import traces
from bufgym.traces import Motion, Trace
from bufgym.traces.generate.sizes import lognormal

# Number of the generator that ``derived_generator`` makes of a stream that draws sizes; of robot or stream r: r more.
SIZES = 1


def derived_generator(rng: np.random.Generator, number: int) -> np.random.Generator:
    """Make another generator from the state of ``rng`` and ``number``; ``rng`` stays where it is."""
    return np.random.default_rng([_state(rng)["state"]["state"], number])


def skip(rng: np.random.Generator, count: int) -> None:
    """Advance ``rng`` as ``rng.random(count)`` does, without drawing."""
    before = _state(rng)
    cast(Any, rng.bit_generator).advance(count)
    rng.bit_generator.state = {**before, "state": _state(rng)["state"]}  # keeps the half word that ``advance`` forgets


def _state(rng: np.random.Generator) -> dict[str, Any]:
    """State of a PCG64, the bit generator of ``Streams``."""
    return cast(dict[str, Any], rng.bit_generator.state)


def place(recordings: tuple[Motion, ...], rng: np.random.Generator, random_offset: bool) -> tuple[Motion, int]:
    """Draw a recording and an offset on it, us, where an episode begins; 0 without ``random_offset``."""
    motion = recordings[int(rng.integers(len(recordings)))]
    return motion, int(rng.integers(motion.time_us[-1])) if random_offset else 0


def place_link(
    links: tuple[Trace, ...], rng: np.random.Generator, random_offset: bool, within_s: tuple[float, float] | None = None
) -> tuple[Trace, int]:
    """Draw a link and an offset on it, us; ``within_s`` limits the offset to from..to, None to anywhere."""
    trace = links[int(rng.integers(len(links)))]
    if not random_offset:
        return trace, 0
    first, last = within_s or (0.0, trace.duration_us / 1e6)
    return trace, int(rng.integers(round(first * 1e6), max(round(last * 1e6), 1 + round(first * 1e6))))


def sizes(n: int, mean_bytes: int, cv: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw int64[n] log-normal sizes, bytes, of that mean and coefficient of variation, at least 1."""
    if not cv:
        return np.full(n, int(mean_bytes), np.int64)
    drawn = mean_bytes * lognormal(rng.standard_normal(n), cv)
    size: NDArray[np.int64] = np.maximum(1, np.rint(drawn)).astype(np.int64)
    return size


def shipped() -> dict[str, Any]:
    """The synthetic LTE links and the drives that come with bufgym, as the parameters ``traces`` and ``motion``."""
    names = traces.shipped()
    return {
        "traces": tuple(traces.load(name) for name in names if name.startswith("lte-")),
        "motion": tuple(traces.load_motion(name) for name in names if name.startswith("drive-")),
    }

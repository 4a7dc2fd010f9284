"""Fit the laws of message sizes to workloads, bags or tables of sizes: `python -m studies.fit_sizes FILE ...`.

The slow part and the part drawn anew come from the covariances of log sizes at lags 1 to `LAGS`, cv^2 of the slow part
times rho^lag, by least squares; the rest of the variance is drawn anew. Long trends of a short recording count as
memory, so rho is known to no more than a few per cent.
"""

import math
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bufgym.cli.options import columns
from bufgym.traces.formats.faults import StrPath
from bufgym.traces.formats.recordings import read_workload
from bufgym.traces.formats.text import open_text
from bufgym.traces.formats.workloads import WORKLOAD_HEADERS
from bufgym.traces.generate.sizes import FLOOR, WINDOW_US, read_sizes, recorded, recorded_sizes, speeds
from bufgym.traces.motion import Motion
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array
from bufgym.utils.errors import BufgymError
from studies.page import command

LAGS: Final = 30
LEAST: Final = 100  # Fewer messages say too little
MOST_EVERY: Final = 300  # Longest group of pictures that is looked for
_RHOS: Final = np.round(np.arange(0, 1, 0.005), 3)
_SHARE: Final = 0.95  # part of the groups, or of the pairs, that must be alike to be taken as such


def fits(path: StrPath) -> dict[str, list[str]]:
    """Topic of a workload, or column of a table of sizes or shipped sequence -> laws as text.

    Raises:
        BufgymError: fewer than `LEAST` messages on every topic, or a broken file.
    """
    if str(path) in recorded():
        return {str(path): laws(recorded_sizes(str(path)))}
    if Path(path).suffix == ".csv" and _header(path) not in WORKLOAD_HEADERS:
        table = read_sizes(Path(path))
        millionths = table.pop("motion", None)
        x = None if millionths is None else millionths / 1e6
        at_30_hz = np.arange(len(next(iter(table.values()), [])), dtype=np.int64) * US_PER_S // 30
        return {name: laws(sizes, at_30_hz, x) for name, sizes in table.items()}
    workload, found = read_workload(path), {}
    for k, name in enumerate(workload.topics):
        chosen = np.flatnonzero(workload.topic == k)
        if len(chosen) >= LEAST:
            moved = None if workload.x is None else workload.x[chosen]
            found[name] = laws(workload.size_bytes[chosen], workload.arrival_us[chosen], moved)
    if not found:
        raise BufgymError(f"{path}: no topic has the {LEAST} messages that a law of sizes needs")
    return found


def laws(sizes: Int64Array, time_us: Int64Array | None = None, x: Float64Array | None = None) -> list[str]:
    """The laws that fit, as text: `gop`, `depth-colour` or else `jpeg`; and `motion` if times and x are known.

    Whole pictures of `gop` do not count for `motion`.
    """
    if len(sizes) < LEAST:
        raise BufgymError(f"{len(sizes)} sizes: must be at least {LEAST} to fit a law")
    if sizes.min() == sizes.max():
        return ["equal"]
    log_size = np.log(sizes)
    ordinary, groups = np.ones(len(sizes), np.bool_), _groups(log_size)
    if groups:
        ordinary = ~groups[1]
        ratio = sizes[~ordinary].mean() / sizes[ordinary].mean()
        found = [f"gop:every={groups[0]},ratio={ratio:.3g},{_parts(log_size[ordinary])}"]
    else:
        found = [_in_turn(log_size) or "jpeg:" + _parts(log_size)]
    if time_us is not None and x is not None and x[-1] > x[0]:
        later = np.append(True, np.diff(time_us) > 0)
        motion = Motion("x", time_us[later] - time_us[0], x[later] - x[0])
        used = ordinary & (time_us - time_us[0] >= WINDOW_US)
        speed, log_size = np.log(FLOOR + speeds(motion, time_us[used] - time_us[0])), log_size[used]
        if speed.std() > 0:
            exponent = float(np.cov(speed, log_size)[0, 1] / np.var(speed, ddof=1))
            left = float((log_size - exponent * speed).var())
            found.append(f"motion:exponent={exponent:.3g},noise={_cv(left):.3g}")
    return found


def _groups(log_size: Float64Array) -> tuple[int, NDArray[np.bool_]] | None:
    """Find messages at even distances that are larger than both neighbours: their distance, and which they are."""
    about, best = log_size - log_size.mean(), (0.0, 0, 0)
    for every in range(2, min(MOST_EVERY, len(about) // 4) + 1):
        rows = about[: len(about) // every * every].reshape(-1, every)
        means = rows.mean(0)
        phase = int(np.argmax(means))
        best = max(best, (float(len(rows) * max(0, means[phase]) ** 2), every, phase))  # variance explained
    _, every, phase = best
    whole = np.arange(len(about)) % max(1, every) == phase
    inside = np.flatnonzero(whole[1:-1]) + 1
    larger = (about[inside] > about[inside - 1]) & (about[inside] > about[inside + 1])
    return (every, whole) if every > 2 and larger.mean() >= _SHARE else None


def _in_turn(log_size: Float64Array) -> str:
    """The law `depth-colour`, if nearly all messages at even places are larger than their successors, or smaller."""
    both = [log_size[first:][: (len(log_size) - first) // 2 * 2].reshape(-1, 2) for first in (0, 1)]
    pairs = min(both, key=lambda pairs: float(np.diff(pairs, axis=1).var()))  # those of one frame differ evenly
    larger = (pairs[:, 0] > pairs[:, 1]).mean()
    between = (pairs[:-1, 1] < pairs[1:, 0]).mean()
    if not (min(larger, between) >= _SHARE or max(larger, between) <= 1 - _SHARE):
        return ""
    ratio = math.exp(abs(float(np.diff(pairs, axis=1).mean())))
    drawn_anew = np.diff(pairs, axis=1).var() / 2
    slow = pairs.mean(1)
    return f"depth-colour:ratio={ratio:.3g},{_parts(slow, drawn_anew)}"


def _parts(log_size: Float64Array, drawn_anew: float | None = None) -> str:
    """`rho`, `cv` and `noise` of log sizes; the variance of the part drawn anew may be known."""
    about = log_size - log_size.mean()
    lags = np.arange(1, min(LAGS, len(about) // 3) + 1)
    covariance = np.array([about[h:] @ about[:-h] / (len(about) - h) for h in lags])
    powers = _RHOS[:, None] ** lags
    variance = np.maximum(0, powers @ covariance / np.maximum((powers**2).sum(1), 1e-12))
    best = int(np.argmin(((covariance - variance[:, None] * powers) ** 2).sum(1)))
    slow = min(float(variance[best]), float(about.var()))
    anew = float(about.var()) - slow if drawn_anew is None else drawn_anew
    return f"rho={_RHOS[best]:g},cv={_cv(slow):.3g},noise={_cv(anew):.3g}"


def _cv(variance: float) -> float:
    """Coefficient of variation of a log-normal number whose logarithm has this variance."""
    return math.sqrt(math.expm1(max(0.0, variance)))


def _header(path: StrPath) -> str:
    with open_text(path) as file:
        first = file.first()
    return "" if first is None else first.text.replace(" ", "")


def main(*files: str) -> None:
    """Print the laws of each topic or column, as `--sizes` of `bufgym bench` takes them.

    Args:
        files: Workloads, bags, tables of sizes, or names of shipped sequences.
    """
    print(columns([(name, "  ".join(laws)) for file in files for name, laws in fits(file).items()]))


if __name__ == "__main__":
    command(main)

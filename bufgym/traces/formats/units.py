"""The unit of times that a file does not name: s, ms, us or ns. docs/methods.md, "Clocks, jumps and units", has rules.

Times that are dates in one unit may be times since a computer's start in another: 1.04e15 is 2003 in us, and 12 days
after the start in ns.
"""

from typing import Final

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault, warn
from bufgym.traces.plausible import DATES_S
from bufgym.traces.trace import Float64Array, Int64Array

UNIT_S: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LEAST_STEP_S: Final = 1e-4  # No camera or robot tells its pose more often
SLOW_STEP_S: Final = 10.0  # Nor most of the time less often than this

_LONGEST_UPTIME_S: Final = 3.2e7  # A year
_USUAL_STEPS_S: Final = (0.9e-3, SLOW_STEP_S)  # From one pose to the next, where only the steps tell the unit
_LONGEST_STEP_S: Final = 3600  # The same where the times count from 1970
_GAP_S: Final = 1.05  # From one pose to the next, with some jitter: longer ones are gaps
_SHARED: Final = 0.1  # Where more samples share a time, the mean step counts
_TOGETHER: Final = 10  # Samples of a burst, at most
_BURST: Final = 20  # Times the median step that samples in bursts are apart on average
_DECIMALS: Final = 4  # Clocks that count in ms have fewer
_FRAMES: Final = 10  # Poses from which on whole numbers in a row look like frame numbers
_SAY: Final = "say format='tum' or 'kitti' (s) or 'euroc' (ns), or put '#timestamp [{0}]' above the first line"


def unit_of(path: StrPath, times: Float64Array, own: str, decimals: int = 0) -> str:
    """The unit of a trajectory's times: that in which they are dates, else that in which poses follow each other.

    ``own``, the unit of the format that the columns suggest, goes before another that is as likely. Times have up to
    this many ``decimals``.
    """
    step = _step(times)
    if step is None:
        return own
    dated = next((unit for unit in UNIT_S if _is_dated(times[0], step, unit)), None)
    running = [unit for unit in UNIT_S if _is_running(times[0], step, unit)]
    if dated is not None:
        if not running or (dated == "s" and decimals >= _DECIMALS):
            return dated
        return _dates_or_uptime(path, times[0], step, own, dated, running[0])
    # Whole steps of 10 are rather ms than one pose in 10 s.
    if not running or (own in running and (step * UNIT_S[own] <= 1 or bool((times % 1).any()))):
        return own
    if len(running) > 1:
        raise _ask(path, step, f"may be {' or '.join(running)}", running[-1])
    return running[0]


def _dates_or_uptime(path: StrPath, first: float, step: float, own: str, dated: str, running: str) -> str:
    """The unit of times that may be dates, or times since the start in a smaller unit: the one without gaps."""
    step_s = step * UNIT_S[dated]
    year = 1970 + first * UNIT_S[dated] / 31_556_952
    days, rate = first * UNIT_S[running] / 86_400, 1 / (step * UNIT_S[running])
    either = f"dates in {dated} ({year:.0f}, {step_s:.4g} s from pose to pose)"
    other = f"times in {running} since a start ({days:.1f} days before, {rate:.4g} poses a second)"
    if own == dated or step_s <= _GAP_S:
        raise _ask(path, step, f"may be of {either} or of {other}", running)
    warn(path, f"times are taken as {other}, not as {either}, which would be all gaps")
    return running


def _ask(path: StrPath, step: float, doubt: str, unit: str) -> Exception:
    return fault(path, f"{doubt}: {_SAY.format(unit)}", value=f"{step:g}", field="median step of the times")


def warn_of_unit(path: StrPath, times: Float64Array, unit: str, named: bool) -> None:
    """Warn of first times that hardly can be in this unit: whole numbers in a row, or a ``named`` unit where only
    another one makes dates or a steady rate."""
    step = _step(times)
    if step is None:
        return
    whole = len(times) >= _FRAMES and bool((np.diff(times) == 1).all()) and times[0] % 1 == 0
    if unit == "s" and whole and not _is_dated(times[0], step, "s"):
        text = f"{times[0]:.0f}, {times[1]:.0f}, {times[2]:.0f}"
        warn(path, f"times {text}, ... look like frame numbers: they are taken as seconds, one pose in each")
    fits = [one for one in UNIT_S if _is_dated(times[0], step, one) or _is_running(times[0], step, one)]
    if named and unit not in fits and len(fits) == 1:
        makes = f"{step * UNIT_S[unit]:.4g} s from pose to pose, where {fits[0]} make {step * UNIT_S[fits[0]]:.4g} s"
        doubt = f"its header says that times are in {unit}, which makes {makes}"
        if step * UNIT_S[unit] < LEAST_STEP_S:
            raise fault(path, f"{doubt}: must say [{fits[0]}]")
        warn(path, doubt)


def _step(times: Float64Array) -> float | None:
    """Median step of the times; their mean where many share one; None where all do."""
    with np.errstate(invalid="ignore"):
        steps = np.diff(times)
    above = steps[(steps > 0) & np.isfinite(steps)]
    if not len(above):
        return None
    if len(times) > 2 * _TOGETHER and (of_bursts := steady_step(times)) > _BURST * np.median(above):
        return of_bursts
    share = len(above) / len(steps)
    return float(np.median(above)) * (share if share < 1 - _SHARED else 1)


def steady_step(times: Float64Array | Int64Array) -> float:
    """Median step over several samples together, so that samples in bursts count by the time between bursts."""
    count = min(_TOGETHER, len(times) - 1)
    return float(np.median(times[count:] - times[:-count])) / count


def _is_dated(first: float, step: float, unit: str) -> bool:
    """Whether a first time is a date in this unit, and poses follow each other within an hour."""
    unit_s = UNIT_S[unit]
    return DATES_S[0] <= first * unit_s < DATES_S[1] and LEAST_STEP_S <= step * unit_s <= _LONGEST_STEP_S


def _is_running(first: float, step: float, unit: str) -> bool:
    """Whether a first time is at most a year after a start in this unit, and poses follow each other as usual."""
    unit_s = UNIT_S[unit]
    return first * unit_s <= _LONGEST_UPTIME_S and _USUAL_STEPS_S[0] <= step * unit_s <= _USUAL_STEPS_S[1]

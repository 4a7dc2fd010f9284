"""Whether what was read can be true: rules over the result, whatever file it came from.

A rule speaks in a warning with numbers and with the option that settles it, or refuses. `python -m studies.plausible`
counts how often each speaks in real recordings.

| rule | speaks where | from |
|---|---|---|
| hole | a step over 10 usual ones and 2 s, or over 60 s and 3 usual ones or an hour more | loggers that stop |
| unit | whole numbers as seconds, not since 1970, 10 s apart or more, no usual number of minutes | loggers of ms |
| clock | every number is HHMMSS, and as a clock the steps are even that are not as seconds | GPS receivers |
| days | days since 1899 | spreadsheets |
| slow poses | poses 0.9 s apart or more that move at less than 1 cm/s, and in ms at a usual speed | times in ms |
| noise | x of every second pose is less than 0.75 of x, or of every third to eighth within 1 s less than 0.6: of real \
motion they are 0.88 and 0.78 or more, of noise 1/2 to 1/8 | UWB, RTK, two sources in one stream |
| jumps | a pose more than 1 m away, at more than 50 m/s, also in a usual step of at most 0.1 s | lost localisation |
| stamps | header stamps go on by less than 0.9 or more than 1.1 s in a second of log time | simulators, other units |
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault, warn
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array, Trace

if TYPE_CHECKING:
    from bufgym.traces.poses import Poses

HOLE_STEPS: Final = 10
HOLE_S: Final = 2
SLOW_STEPS: Final = 3
SLOW_S: Final = 60
HOUR_S: Final = 3600
FEW: Final = 0.1  # Of all messages

LEAST_SAMPLE_S: Final = 1e-3  # No tool measures a link more often
MS_STEP_S: Final = 10  # Steps of ms look like these seconds; of seconds, these are usual:
USUAL_S: Final = (60, 120, 180, 240, 300, 600, 900, 1200, 1800)
DATES_S: Final = (9.4e8, 2.84e9)  # Seconds since 1970 from 2000 until 2059
_SERIAL_DAYS: Final = (36_526, 58_074)  # Days since 1899-12-30, as spreadsheets count, from 2000 until 2058

SLOW_POSES_S: Final = 0.9
SLOW_M_PER_S: Final = 0.01
FAST_M_PER_S: Final = 50
_STANDS_M: Final = 1.0  # Shorter ways are no jump at any speed: two poses may be logged within microseconds
_MOST_USUAL_S: Final = 0.1  # So may a car's of a usual step each, which came in a burst; but a slow topic jumps, too

NOISE: Final = {2: 0.75, **dict.fromkeys(range(3, 9), 0.6)}  # Every how many poses -> least share of x
NOISE_POSES: Final = 50  # Fewer do not tell

STAMP_RATES: Final = (0.9, 1.1)
STAMPED: Final = 10  # Messages of a topic; fewer do not tell


class Hole(NamedTuple):
    """A stretch without samples."""

    start_us: int  # a usual step after the last sample before it
    end_us: int  # the next sample
    before: int  # which sample is the last before it


def holes(time_us: Int64Array) -> list[Hole]:
    """Stretches without samples at these times, int64[n]."""
    steps_us = np.diff(time_us)
    if len(steps_us) < 2:
        return []
    usual_us = round(float(np.median(steps_us)))
    long = (steps_us > HOLE_STEPS * usual_us) & (steps_us > HOLE_S * US_PER_S)
    slow = (steps_us >= SLOW_STEPS * usual_us) & (steps_us > SLOW_S * US_PER_S)
    hour = (steps_us - usual_us >= HOUR_S * US_PER_S) & (steps_us > SLOW_S * US_PER_S)
    found = np.flatnonzero(long | slow | hour).tolist()
    return [Hole(int(time_us[k]) + usual_us, int(time_us[k + 1]), k) for k in found]


def check_seconds(path: StrPath, numbers: Float64Array, *, refuse_ms: bool = False) -> None:
    """Check that times given as numbers without a unit, float64[n], can be seconds.

    ``refuse_ms``: they are of messages, which no robot sends so rarely.
    """
    first = float(numbers[0])
    steps = np.diff(numbers)
    step_s = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    if not step_s:
        return
    is_day = _SERIAL_DAYS[0] <= first < _SERIAL_DAYS[1] and step_s < 0.5
    if is_day and (step_s < LEAST_SAMPLE_S or (_is_whole(step_s * 86_400) and not _is_whole(step_s * 1000))):
        rule = "looks like days, as a spreadsheet writes dates: must be in s, or a date as 2024-01-31 12:00:00"
        raise fault(path, rule, value=f"{first:.10g}", field="time in s")
    if step_s < LEAST_SAMPLE_S and not refuse_ms:
        rule = f"must be at least {LEAST_SAMPLE_S:g} s (are the times in another unit?)"
        raise fault(path, rule, value=f"{step_s:.3g} s", field="median step of the times")
    if _is_clock(numbers, step_s):
        rule = "looks like a clock's HHMMSS, as GPS receivers write: must be in s, or a date as 2024-01-31 12:00:00"
        raise fault(path, rule, value=f"{first:06.10g}", field="time in s")
    usual = any(abs(step_s / usual - 1) < 0.01 for usual in USUAL_S) or _is_whole(step_s / HOUR_S)
    whole = bool((numbers % 1 == 0).all())
    if not whole or step_s < MS_STEP_S or DATES_S[0] <= first < DATES_S[1] or (usual and not refuse_ms):
        return
    unit = "us" if step_s >= 10_000 else "ms"
    total_s = float(numbers[-1] - first)
    in_unit_s = total_s / (1e6 if unit == "us" else 1e3)
    if refuse_ms:
        rule = (
            f"may be s ({total_s:,.6g} s in all) or {unit} ({in_unit_s:,.6g} s): name the column time_{unit}, "
            "or write seconds with a decimal point"
        )
        raise fault(path, rule, value=f"{step_s:.6g}", field="median step of the times")
    warn(
        path,
        f"its times are {step_s:.6g} s apart (median): are they in {unit}? they are taken as seconds, {total_s:,.6g} s "
        f"in all, and not {in_unit_s:,.6g} s (a header time_{unit},mbps says {unit})",
    )


def _is_clock(numbers: Float64Array, step_s: float) -> bool:
    """Whether numbers are times of day as HHMMSS: each is one, and the steps across a full minute are usual so."""
    minute, second = numbers // 100 % 100, numbers % 100
    if numbers[-1] >= 240_000 or numbers[0] < 0 or (minute >= 60).any() or (second >= 60).any():
        return False
    clock_s = numbers // 10_000 * 3600 + minute * 60 + second
    odd = np.abs(np.diff(numbers) - step_s) > 1e-6
    return bool(odd.any()) and float(np.mean(np.abs(np.diff(clock_s)[odd] - step_s) < 1e-6)) > 0.5


def _is_whole(value: float) -> bool:
    """Whether a number is about a whole number above 0: days in whole microseconds of a day are off by 0.04 s."""
    return round(value) > 0 and abs(value - round(value)) < 0.05


def over_holes(path: StrPath, trace: Trace, ends: Sequence[tuple[int, str]], time_us: Int64Array, policy: str) -> Trace:
    """The trace with its holes, as the ``policy`` says; ``ends`` are line and time at the end of each interval."""
    # A rate of 0 before a hole says the same either way.
    found = [hole for hole in holes(time_us) if trace.rate_bytes_per_s(hole.start_us) > 0]
    if not found:
        return trace
    longest = max(found, key=lambda hole: hole.end_us - hole.start_us)
    usual_s, hole_s = (
        (longest.start_us - int(time_us[longest.before])) / US_PER_S,
        np.diff(time_us)[longest.before] / 1e6,
    )
    count = f", the longest of {len(found)} holes" if len(found) > 1 else ""
    line, time = ends[longest.before]
    hole = f"{time} is {hole_s:.10g} s after the line above{count}, where {usual_s:g} s is usual"
    if policy == "refuse":
        raise fault(path, f"{hole}: say --holes hold, or --holes zero (holes='zero')", line=line)
    held = replace(trace, holes=tuple((hole.start_us, hole.end_us) for hole in found))
    empty = held.with_holes("zero")
    means = {"hold": f"{held.mean_bytes_per_s / 1e3:,.6g} KB/s", "zero": f"{empty.mean_bytes_per_s / 1e3:,.6g} KB/s"}
    done, other = ("nothing is sent", "hold") if policy == "zero" else ("the rate is held", "zero")
    warn(path, f"{hole}: {done}, mean {means[policy]} (--holes {other}: {means[other]})", line=line)
    return empty if policy == "zero" else held


def warn_of_pauses(path: StrPath, time_us: Int64Array, topic: Int64Array, names: Sequence[str]) -> None:
    """Warn of stretches without a message, int64[n]; a few alone before or after the longest are named by topic."""
    found = holes(np.unique(time_us))
    if not found:
        return
    start_us, end_us = max(((hole.start_us, hole.end_us) for hole in found), key=lambda hole: hole[1] - hole[0])
    count = f", the longest of {len(found)} holes" if len(found) > 1 else ""
    doubt = f"no message for {(end_us - start_us) / US_PER_S:,.6g} s{count}, from {start_us / US_PER_S:,.6g} s on"
    for side, beside in (("before", time_us < end_us), ("after", time_us >= end_us)):
        if np.count_nonzero(beside) <= max(1, FEW * len(time_us)):
            on = ", ".join(sorted({names[k] for k in topic[beside]}))
            doubt += f", {side} which are {np.count_nonzero(beside)} of {len(time_us):,} messages ({on}) alone"
    warn(path, f"{doubt}: nothing is sent in it")


def check_slow_poses(path: StrPath, poses: "Poses") -> None:
    """Refuse poses whose times, of no named unit, may be ms in place of s: by their steps and their speed."""
    step_s = float(np.median(np.diff(poses.time_us))) / US_PER_S
    if step_s < SLOW_POSES_S or DATES_S[0] <= poses.start_us / US_PER_S < DATES_S[1]:
        return
    speed = poses.path_m() * US_PER_S / float(poses.time_us[-1])
    if speed < SLOW_M_PER_S < speed * 1000 < FAST_M_PER_S:
        rule = (
            f"may be s, at {speed:.3g} m/s, or ms, at {speed * 1000:.3g} m/s: say format='tum' (s), or put "
            "'#timestamp [ms]' above the first line"
        )
        raise fault(path, rule, value=f"{step_s:g}", field="median step of the times")


def doubt_of_noise(shares: dict[int, float], x: float) -> str:
    """Doubt about motion of which every second, third, ... pose alone has these shares; "" for none."""
    k = next((k for k, share in shares.items() if share < NOISE[k]), 0)
    if not k:
        return ""
    noise = min((1 - shares[k]) * k / (k - 1), 1)
    which = "second" if k == 2 else f"{k}th"
    return (
        f"x of every {which} pose is {shares[k]:.2f} of x (real motion 0.88 and more, noise 1/{k}): about {noise:.0%} "
        f"of x = {x:.3f} is noise of the positions, or hops between two sources (from-bag --rate-hz compares poses "
        "less often)"
    )


def warn_of_jumps(path: StrPath, poses: "Poses") -> None:
    """Warn of poses that no robot can reach from the pose before: localisation was lost, or numbers are wrong."""
    moved_m = np.concatenate([np.linalg.norm(np.diff(piece.position_m, axis=0), axis=1) for piece in poses.pieces()])
    step_s = np.diff(poses.time_us) / US_PER_S
    usual_s = min(float(step_s.mean()), _MOST_USUAL_S)
    jumps = np.flatnonzero((moved_m > _STANDS_M) & (moved_m > FAST_M_PER_S * np.maximum(step_s, usual_s)))
    if not len(jumps):
        return
    k = int(jumps[0])
    more = f", the first of {len(jumps)} jumps" if len(jumps) > 1 else ""
    warn(
        path,
        f"pose {k + 2} of {len(poses.time_us)} ({poses.format}), {poses.time_us[k + 1] / US_PER_S:.3f} s after the "
        f"first, is {moved_m[k]:.6g} m from the one {step_s[k]:.6g} s before{more}: no robot is faster than "
        f"{FAST_M_PER_S} m/s, and x counts it as motion",
    )


def stamp_rate(path: StrPath, topic: str, log_ns: Int64Array, stamp_ns: Int64Array, settled: bool) -> float | None:
    """Seconds of a topic's header stamps in a second of log time; None for too few messages.

    Warns of odd ones, unless the user has chosen the clock.
    """
    if len(log_ns) < STAMPED or log_ns[-1] <= log_ns[0] or stamp_ns[-1] <= stamp_ns[0]:
        return None
    rate = float(stamp_ns[-1] - stamp_ns[0]) / float(log_ns[-1] - log_ns[0])
    if not settled and not STAMP_RATES[0] <= rate <= STAMP_RATES[1]:
        stamps_s, log_s = (float(times[-1] - times[0]) / 1e9 for times in (stamp_ns, log_ns))
        warn(
            path,
            f"header stamps on {topic} go on by {rate:.4g} s in a second of log time ({stamps_s:.6g} s in "
            f"{log_s:.6g} s): a simulation at another speed, or log times in another unit? arrivals are log times "
            "(--clock stamps takes the stamps' clock)",
        )
    return rate

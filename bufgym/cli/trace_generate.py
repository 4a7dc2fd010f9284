"""``bufgym trace generate``: links, motions and frame sizes from a seed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from bufgym.cli.options import Count, Least0, Natural, Positive, checked
from bufgym.ground.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.traces import Trace

Out = Annotated[Path, Parameter(alias="-o", help="The CSV to write.")]
Seed = Annotated[Natural, Parameter(help="Whole number >= 0.")]
Seconds = Annotated[Positive, Parameter(help="Length, s.")]


def _pair(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))


Range = Annotated[
    tuple[float, ...],
    checked(_pair, lambda pair: len(pair) == 2 and pair[0] <= pair[1], "two numbers, LOW,HIGH, the lower one first"),
]


def _write(trace: Trace, out: Path) -> None:
    from bufgym import traces

    traces.write_csv(trace, out)
    print(f"wrote {out}: {trace.source}, mean {trace.mean_bytes_per_s / 1e6:.3f} MB/s")


# --- links -----------------------------------------------------------------------------------------------------------


def link(
    *,
    mode: str,
    seed: Seed = 0,
    duration: Seconds = 300.0,
    mean: Positive | None = None,
    links: str | None = None,
    out: Out,
) -> None:
    """Make a mobile link as recorded in trams, trains, ... (or in WiFi).

    Args:
        mode: foot, bicycle, bus, tram, train, car, wifi-...
        mean: Scale to this mean, bytes/s (default: as recorded).
        links: Parameters made by 'bufgym trace fit' (default: bufgym's own).
    """
    from bufgym import traces

    parameters = None if links is None else traces.read_links(links)
    made: Any = traces.markov_link
    _write(made(mode, seed, duration, mean_bytes_per_s=mean, links=parameters), out)


def gilbert_elliott(
    *,
    seed: Seed = 0,
    duration: Seconds = 300.0,
    good: Least0 = 10e6,
    bad: Least0 = 0.0,
    mean_good: Positive = 20.0,
    mean_bad: Positive = 2.0,
    out: Out,
) -> None:
    """Make a link of two states, good and bad.

    Args:
        good: Rate, bytes/s.
        bad: Rate, bytes/s.
        mean_good: Mean stay, s.
        mean_bad: Mean stay, s.
    """
    from bufgym import traces

    stays = {"mean_good_s": mean_good, "mean_bad_s": mean_bad}
    _write(traces.gilbert_elliott(seed, duration, good_bytes_per_s=good, bad_bytes_per_s=bad, **stays), out)


def roaming(
    *,
    seed: Seed = 0,
    duration: Seconds = 300.0,
    access_points: Count = 4,
    spacing: Positive = 50.0,
    speed: Positive = 1.0,
    gap: Least0 = 1.0,
    out: Out,
) -> None:
    """Make WiFi past access points, with hand-overs.

    Args:
        access_points: In a row.
        spacing: Between them, m.
        speed: Of the robot, m/s.
        gap: Without a link at a hand-over, s.
    """
    from bufgym import traces

    corridor = traces.Corridor(access_points=access_points, spacing_m=spacing, speed_m_per_s=speed, gap_s=gap)
    _write(traces.roaming(seed, duration, corridor), out)


def steady(*, rate: Positive = 10e6, duration: Seconds = 300.0, out: Out) -> None:
    """Make one rate throughout.

    Args:
        rate: Bytes/s.
    """
    from bufgym import traces

    _write(traces.steady(rate, duration), out)


def ramp(*, start: Least0 = 12.5e6, end: Least0 = 0.5e6, duration: Seconds = 15.0, out: Out) -> None:
    """Make a rate that changes evenly (default: Robofleet's 100 to 4 Mbit/s).

    Args:
        start: Rate at first, bytes/s.
        end: Rate at last, bytes/s.
    """
    from bufgym import traces

    _write(traces.ramp(start, end, duration), out)


def tunnel(
    *,
    rate: Positive = 10e6,
    before: Least0 = 20.0,
    fade: Least0 = 3.0,
    blackout: Least0 = 10.0,
    recover: Least0 = 2.0,
    after: Least0 = 20.0,
    out: Out,
) -> None:
    """Make a drive through a tunnel: steady, fade, blackout, fade in, steady.

    Args:
        rate: Outside, bytes/s.
        before: Length, s.
        fade: Length, s.
        blackout: Length, s.
        recover: Length, s.
        after: Length, s.
    """
    from bufgym import traces

    lengths = {"before_s": before, "fade_s": fade, "blackout_s": blackout, "recover_s": recover, "after_s": after}
    _write(traces.tunnel(rate, **lengths), out)


# --- motion and frames -----------------------------------------------------------------------------------------------


def drive(
    *, seed: Seed = 0, duration: Seconds = 300.0, cruise: Range = (0.5, 1.5), turn: Range = (30.0, 60.0), out: Out
) -> None:
    """Make the motion of a robot that cruises, turns in place and stops.

    Args:
        cruise: Speeds, LOW,HIGH, m/s.
        turn: Turn rates in place, LOW,HIGH, degrees/s.
    """
    from bufgym import traces

    ranges: dict[str, Any] = {"cruise_m_per_s": cruise, "turn_deg_per_s": turn}
    motion = traces.drive_motion(seed, duration, traces.Driving(**ranges))
    traces.write_motion_csv(motion, out)
    print(f"wrote {out}: {motion.source}, {motion.total:.3f} views")


def frames(
    *,
    seed: Seed = 0,
    duration: Seconds = 300.0,
    motion: str | None = None,
    rate_hz: Positive = 30.0,
    base: Positive = 230_000.0,
    out: Out,
) -> None:
    """Make RGB-D frames whose sizes follow motion and detail (time_s,bytes,x).

    Args:
        motion: A motion or trajectory, or a shipped name (default: drive).
        rate_hz: Frames a second.
        base: Bytes at rest.
    """
    import numpy as np

    from bufgym import traces

    number = duration * rate_hz
    if not 1 <= number <= 1e7:
        raise BufgymError(f"--duration x --rate-hz = {number:g} frames: must be from 1 to 1e7")
    moved = traces.load_motion(motion) if motion else traces.drive_motion(seed, duration)
    arrival_us = np.rint(np.arange(int(number)) * (1e6 / rate_hz)).astype(np.int64)
    sizes = traces.frame_sizes(arrival_us, moved, seed, traces.FrameModel(base_bytes=base))
    x = moved.at(arrival_us)
    traces.write_workload_csv(traces.Workload("frames", arrival_us, sizes, x=x - x[0]), out)
    print(f"wrote {out}: {len(sizes)} frames, mean {sizes.mean() / 1e3:.1f} kB")

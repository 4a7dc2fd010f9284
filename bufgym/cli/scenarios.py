"""Scenario that options describe: a stream over traces, a recording, one interruption, or one of the user's own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cyclopts import Group, Parameter

from bufgym.cli.options import Count, Least0, Positive, given, refuse
from bufgym.cli.trace_bags import MOTION, MotionOptions, RecordingOptions, workload_lines
from bufgym.ground import modules
from bufgym.ground.errors import BufgymError, printable

if TYPE_CHECKING:
    from bufgym.scenario import Scenario, Uplink
    from bufgym.traces import Motion

SCORE = "Score: 0 is Drop Oldest, 1 the clairvoyant; regret = 1 - QoI / the clairvoyant's."
"""Legend of the table's first columns."""

_PARAMETERS = {"trace": "traces", "fps": "rate_hz", "bytes": "size_bytes", "seconds": "duration_s"}
"""Options whose scenario parameter has another name. Options not given take the scenario's defaults, and text is read
there."""

_MESSAGES = ("fps", "bytes", "size_cv", "sizes", "seconds", "jitter")
"""Options of a made stream, which a recording has itself."""


@Parameter(name="*", group=Group.create_ordered("The stream and its link (default: as in bufgym/Uplink-v0)"))
@dataclass(frozen=True)
class StreamOptions:
    trace: list[str] | None = None
    """Bandwidth traces: files, shipped names, or module:function, a seed -> Trace (default: shipped LTE)."""
    motion: list[str] | None = None
    """Motion recordings, likewise; 'none': x is the frame index."""
    fps: Positive | None = None
    """Messages a second."""
    bytes: Count | None = None
    """Mean message size, bytes."""
    size_cv: Least0 | None = None
    """Coefficient of variation of the size; 0: all equal."""
    sizes: str | None = None
    """Law of the sizes: jpeg, gop, depth-colour, motion, recorded:NAME; with parameters jpeg:cv=0.3."""
    seconds: Positive | None = None
    """Length of an episode, s."""
    tells_duration: bool = False
    """The sender is told beforehand how long the stream lasts."""
    jitter: Least0 | None = None
    """Arrivals move by up to this part of a period."""
    scale: Positive | None = None
    """Multiply the link's capacity (default: 1)."""
    value: str | None = None
    """V of the QoI: exponential:BASE, saturating:DISTANCE, tabulated:D=V,..., or module:function of your own
    (default: exponential:0.05 over motion, exponential:0.367879 over a recording's motion, exponential:0.618 over
    frame indices)."""


@Parameter(name="*", group=Group.create_ordered("A recording of a robot in place of the stream"))
@dataclass(frozen=True)
class WorkloadOptions(RecordingOptions):
    workload: str | None = None
    """MCAP, ROS 1 bag, rosbag2 (extra 'ros') or CSV; alone, played once from the start of each trace."""


@Parameter(name="*", group=Group.create_ordered("One interruption of unknown length T instead"))
@dataclass(frozen=True)
class InterruptionOptions:
    interruption: bool = False
    """This scenario, and regret against its oracle."""
    law: str | None = None
    """Of T: fixed (t-max), uniform, log-uniform, geometric (default: log-uniform)."""
    t_min: Count | None = None
    """Shortest, messages (default: 1)."""
    t_max: Count | None = None
    """Longest, messages (default: 400)."""
    t_mean: Positive | None = None
    """Mean of the geometric law (default: 100)."""


@Parameter(name="*", group=Group.create_ordered("A scenario of your own instead"))
@dataclass(frozen=True)
class OwnOptions:
    scenario_file: str | None = None
    """A Python file that registers it; its code is run."""
    scenario: str | None = None
    """Which; also any other in 'bufgym list scenarios', or module:function."""


@dataclass(frozen=True)
class ScenarioOptions:
    """All options that describe a scenario."""

    stream: StreamOptions
    workload: WorkloadOptions
    interruption: InterruptionOptions
    own: OwnOptions

    def given(self) -> dict[str, Any]:
        """What the user gave."""
        return given(self.interruption) | given(self.stream) | given(self.workload) | given(self.own)

    def scenario(self, seeds: int | None) -> tuple[Scenario, str]:
        """Make the scenario, and a few lines about it; ``seeds`` is None where the user gave none."""
        stream, workload, law = self.stream, self.workload, given(self.interruption)
        if given(self.own):
            described = {name: value for name, value in self.given().items() if name not in vars(self.own)}
            refuse(described, "cannot go with a scenario of your own, which says it itself")
            return _own(self.own, seeds or 10)
        if law.pop("interruption", False):
            uplinks = {name: v for name, v in given(stream).items() if name not in ("fps", "bytes", "sizes", "value")}
            refuse(uplinks | given(workload), "cannot go with --interruption")
            return _interruption(stream, law, seeds or 10)
        refuse(law, "needs --interruption")
        if workload.workload is not None:
            return _recording(workload.workload, stream, workload, seeds)
        refuse(given(workload, "topics", "odom", "bridge_gaps"), "needs --workload")
        if stream.motion is None:
            refuse(given(workload, *MOTION), "needs --motion, or --workload with --odom")
        return _uplink(stream, workload, seeds or 10)


def _parameters(options: StreamOptions, *names: str) -> dict[str, Any]:
    """Select the options that the user gave, as parameters of the scenario."""
    return {_PARAMETERS.get(name, name): value for name, value in given(options, *names).items()}


def _own(options: OwnOptions, seeds: int) -> tuple[Scenario, str]:
    """Find a scenario by name after running the file that registers it."""
    from bufgym import scenario as scenarios
    from bufgym.benchmark.run import by_trace

    before, name = dict(scenarios.SCENARIOS), options.scenario
    if options.scenario_file is not None:
        modules.run_file(options.scenario_file, "--scenario-file")
    added = [key for key, entry in scenarios.SCENARIOS.items() if before.get(key) is not entry]
    if name is None and len(added) != 1:
        names = f"registers {', '.join(added)}: choose by --scenario" if added else "registers no scenario"
        raise BufgymError(f"{options.scenario_file}: {names}")
    name = name or added[0]
    found = scenarios.get(name)
    if found.topics:
        raise BufgymError(f"scenario {name}: has several topics; bufgym bench runs those of one queue")
    what = scenarios.SCENARIOS[name][1] if name in scenarios.SCENARIOS else type(found).__name__
    traces = len(by_trace(found))
    met = "" if traces == 1 else f"{traces} traces x "
    return found, "\n".join(
        [
            f"Scenario {printable(name)}: {printable(what)}",
            f"QoI = 1 + sum of V(step in x) over the messages received; V = {printable(found.value.name)}.",
            f"Means over {met}{seeds} seeds; every policy meets the same episodes.",
            SCORE,
        ]
    )


def _interruption(stream: StreamOptions, settings: dict[str, Any], seeds: int) -> tuple[Scenario, str]:
    from bufgym.scenario import Interruption

    made = Interruption(**settings, **_parameters(stream, "fps", "bytes", "sizes", "value"))
    length = f"T = {made.t_max}" if made.law == "fixed" else f"T {made.law} on {made.t_min}..{made.t_max}"
    about = f"One interruption of T messages, {length}; V = {made.value.name} over frame indices."
    return made, f"{about}\nMeans over {seeds} seeds. {SCORE}"


def _uplink(stream: StreamOptions, measured: MotionOptions, seeds: int) -> tuple[Scenario, str]:
    from bufgym.model import qoi

    settings = _parameters(stream)
    if stream.motion is not None:
        settings["motion"] = _motions(stream.motion, measured)
    if stream.motion == ["none"]:
        settings = {"value": qoi.exponential(), **settings}
    uplink = _over_lte(**settings)
    recorded = _some([_with_gaps(motion) for motion in uplink.motion])
    x = f"the camera's motion, in fields of view, from {recorded}" if uplink.motion else "the frame index"
    traces_met = f"{len(uplink.traces)} {'trace' if len(uplink.traces) == 1 else 'traces'}"
    about = [
        f"{uplink.rate_hz:g} messages/s of {uplink.size_bytes} bytes for {uplink.duration_s:g} s"
        f" over {_over(uplink)}, from random offsets.",
        *_measured(uplink, x),
        f"Means over {traces_met} x {seeds} seeds; every policy meets the same episodes.",
        SCORE,
    ]
    return uplink, "\n".join(about)


def _recording(
    file: str, stream: StreamOptions, recording: RecordingOptions, seeds: int | None
) -> tuple[Scenario, str]:
    """Make a workload as recorded; with --seeds it starts at random places of each trace."""
    from bufgym.model import qoi
    from bufgym.traces import read_workload

    refuse(given(stream, *_MESSAGES), "cannot go with --workload: a recording has its own")
    workload = read_workload(file, **recording.arguments())
    motions = _motions(stream.motion or [], recording)
    if recording.odom is None and not motions:
        refuse(given(recording, *MOTION), "needs --odom or --motion")
    by_motion = bool(motions) or workload.x is not None
    value = stream.value or (qoi.exponential(math.exp(-1)) if by_motion else qoi.exponential())
    settings = _parameters(stream, "trace", "scale", "tells_duration")
    uplink = _over_lte(motion=motions, random_offset=seeds is not None, value=value, workload=workload, **settings)
    source = f"from {_some([_with_gaps(motion) for motion in motions])}" if motions else "as recorded"
    places = "from the trace's start" if seeds is None else f"{seeds} random places each"
    shared = "; all topics share one queue" if len(workload.topics) > 1 else ""
    about = [
        *(printable(workload.source), "", *workload_lines(workload), ""),
        f"Played over {_over(uplink)}, {places}{shared}.",
        *_measured(uplink, f"the motion, {source}, in fields of view" if by_motion else "the number of the message"),
    ]
    return uplink, "\n".join([*about, SCORE])


def _over_lte(**settings: Any) -> Uplink:
    """Change the uplink over the shipped links."""
    from bufgym.scenario import Uplink, get

    uplink = get("lte", **settings)
    assert isinstance(uplink, Uplink)
    return uplink


def _over(uplink: Uplink) -> str:
    scaled = f" x {uplink.scale[0]:g}" if uplink.scale != (1.0,) else ""
    return _some([trace.name for trace in uplink.traces]) + scaled


def _measured(uplink: Uplink, x: str) -> list[str]:
    return [f"QoI = 1 + sum of V(step in x) over the messages received; V = {uplink.value.name}.", f"x is {x}."]


def _motions(names: Sequence[str], measured: MotionOptions) -> tuple[Motion, ...]:
    """Load motions by shipped name or from files, measured as the options say; ``["none"]`` gives none."""
    from bufgym import traces
    from bufgym.traces.formats.motions import MOTION_HEADER

    settings, motions = measured.settings(), []
    for name in () if list(names) == ["none"] else names:
        if settings is None:
            motions.append(traces.load_motion(name))
            continue
        motions.append(traces.read_motion(traces.shipped().get(name, name), settings))
        if motions[-1].source.endswith(f"({MOTION_HEADER})"):
            refuse(given(measured, *MOTION), f"cannot go with {name}, which holds finished coordinates")
    return tuple(motions)


def _with_gaps(motion: Motion) -> str:
    """Write its name and the interpolated share."""
    if not motion.gaps:
        return motion.name
    return f"{motion.name} (gaps bridged: {len(motion.gaps)}, the longest {motion.longest_gap_s:.1f} s)"


def _some(names: Sequence[str]) -> str:
    return printable(", ".join(names) if len(names) <= 3 else f"{names[0]} .. {names[-1]}")

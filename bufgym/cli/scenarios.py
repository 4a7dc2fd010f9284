"""Scenario that options describe: a stream over traces, a recording, one interruption, or a named one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cyclopts import Group, Parameter

from bufgym.cli.options import Bytes, Count, Holes, Least0, Positive, Whole, given, refuse
from bufgym.cli.trace_bags import MOTION, MotionOptions, RecordingOptions, workload_lines
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError, printable
from bufgym.utils.progress import bar

if TYPE_CHECKING:
    from bufgym.traces import Motion, Trace

_PARAMETERS = {"trace": "traces", "fps": "rate_hz", "bytes": "size_bytes", "seconds": "duration_s"}
"""Options whose scenario parameter has another name. Options not given take the scenario's defaults, and text is read
there."""

_MESSAGES = ("fps", "bytes", "size_cv", "sizes", "seconds", "jitter")
"""Options of a made stream, which a recording has itself."""

_MOST_FACTS = 3  # Recordings whose facts stand above a table
_OF_A_CLIENT = ("trace", "motion", "scale", "holes")  # Options that a client of one's own takes too


@Parameter(name="*")
@dataclass(frozen=True)
class LinkOptions:
    trace: list[str] | None = None
    """Bandwidth traces, as in a,b or a b: files, shipped names, a rate as in 20Mbit/s, or module:function, a seed ->
    Trace (default: shipped LTE)."""
    motion: list[str] | None = None
    """Motion recordings, likewise (default: shipped drives); 'none': x is the frame index."""
    scale: Positive | None = None
    """Multiply the link's capacity (default: 1)."""
    holes: Holes | None = None
    """Where a trace has no samples: hold the rate before (default), send nothing, or refuse the file."""


@Parameter(name="*", group=Group.create_ordered("The stream and its link (default: as in bufgym/Uplink-v0)"))
@dataclass(frozen=True)
class StreamOptions(LinkOptions):
    fps: Positive | None = None
    """Messages a second (default: 30)."""
    bytes: Bytes | None = None
    """Mean message size, bytes, or with a unit as in 4.6MB (default: 4608000; of an interruption: 230000)."""
    size_cv: Least0 | None = None
    """Coefficient of variation of the size (default: 0, all equal)."""
    sizes: str | None = None
    """Law of the sizes: jpeg, gop, depth-colour, motion, recorded:NAME; with parameters jpeg:cv=0.3 (default:
    equal)."""
    seconds: Positive | None = None
    """Length of an episode, s (default: 30)."""
    tells_duration: bool = False
    """The sender is told beforehand how long the stream lasts."""
    jitter: Least0 | None = None
    """Arrivals move by up to this part of a period (default: 0.1)."""
    value: str | None = None
    """V of the QoI: exponential:BASE, saturating:DISTANCE, tabulated:D=V,..., or module:function of your own
    (default: exponential:0.05 over motion, exponential:0.367879 over a recording's motion, exponential:0.618 over
    frame indices)."""


@Parameter(name="*", group=Group.create_ordered("A recording of a robot in place of the stream"))
@dataclass(frozen=True)
class WorkloadOptions(RecordingOptions):
    workload: list[str] | None = None
    """MCAP, ROS 1 bag, rosbag2 (extra 'ros') or CSV; several are one drive; alone, played once from the start of each
    trace."""
    columns: list[str] | None = None
    """Of any other table: the columns of times, of bytes and, if there is one, of topics, by name or number."""
    time_unit: str | None = None
    """Of its times: s, ms, us, ns (default: that in the column's name, else s)."""

    def arguments(self) -> dict[str, Any]:
        """Collect those given for ``read_workload``."""
        if self.columns is None:
            refuse(given(self, "time_unit"), "needs --columns")
            return super().arguments()
        from bufgym.traces import Columns

        if len(self.columns) not in (2, 3):
            raise BufgymError(f"--columns {' '.join(self.columns)}: must be TIME BYTES or TIME BYTES TOPIC")
        time, size, topic = [*self.columns, ""][:3]
        chosen = Columns(time, bytes=size, topic=topic, time_unit=self.time_unit or "")
        return {**super().arguments(), "columns": chosen}


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
    """Which; also any other in 'bufgym list scenarios', with parameters as in lte:rate_hz=5, or module:function."""
    config: str | None = None
    """A client's topics and their rules, as in examples/client.toml; --trace, --motion and --scale give its links."""


@Parameter(name="*")
@dataclass(frozen=True)
class SendOptions:
    consumers: Whole | None = None
    """How many want each message; native ROS sends each a copy (default: as the scenario says)."""
    window: Whole | None = None
    """n_T: messages sent and not yet acknowledged, at most (default: as the scenario says)."""


@Parameter(name="*", group=Group.create_ordered("Several topics or robots, of a suite or a scenario"))
@dataclass(frozen=True)
class SharedOptions(SendOptions):
    robots: Count | None = None
    """That share the cell of a fleet, whose capacity grows with them (default: 16)."""


class Described(NamedTuple):
    """A scenario that options describe."""

    scenario: Any
    lines: Sequence[str] = ()
    """What is to be said of it besides its own ``about``."""
    label: str = ""
    """Its name in rows."""
    recorded: bool = False
    """Whether it plays a recording."""
    facts: Sequence[str] = ()
    """Lines on the recordings that the user named."""


@dataclass(frozen=True)
class ScenarioOptions:
    stream: StreamOptions
    workload: WorkloadOptions
    interruption: InterruptionOptions
    own: OwnOptions
    shared: SharedOptions

    def given(self) -> dict[str, Any]:
        """What the user gave, besides changes that a suite takes too."""
        return given(self.interruption) | given(self.stream) | given(self.workload) | given(self.own)

    def scenario(self, seeds: int | None) -> Described:
        """Make the scenario; ``seeds`` is None where the user gave none."""
        from bufgym import scenario as scenarios

        stream, workload, law = self.stream, self.workload, given(self.interruption)
        if given(self.own):
            return self._own()
        refuse(given(self.shared), "needs --suite, --scenario or --config of several topics or robots")
        if law.pop("interruption", False):
            uplinks = {name: v for name, v in given(stream).items() if name not in ("fps", "bytes", "sizes", "value")}
            refuse(uplinks | given(workload), "cannot go with --interruption")
            law |= _parameters(stream, "fps", "bytes", "sizes", "value")
            return Described(scenarios.get("interruption", **law))
        refuse(law, "needs --interruption")
        if workload.workload is not None:
            return recorded(workload.workload, stream, workload, seeds)
        refuse(given(workload, "topics", "odom", "bridge_gaps", "columns", "time_unit"), "needs --workload")
        if stream.motion is None:
            refuse(given(workload, *MOTION), "needs --motion, or --workload with --odom")
        return _uplink(stream, workload)

    def _own(self) -> Described:
        """The client of a file, or a scenario by name after the file that registers it was run."""
        from bufgym import scenario as scenarios

        config, allowed = self.own.config, () if self.own.config is None else _OF_A_CLIENT
        described = {name: v for name, v in self.given().items() if name not in (*vars(self.own), *allowed)}
        refuse(described, "cannot go with a scenario of your own, which says it itself")
        changes = _parameters(self.stream, *allowed) if allowed else {}
        changes |= given(self.shared)
        if config is not None:
            refuse(given(self.own, "scenario", "scenario_file"), "cannot go with --config")
            # What the user typed does not go through ``read_client``, whose errors name the file.
            client = scenarios.get(scenarios.read_client(config), **changes)
            return Described(client, [f"The client of {printable(config)}."], Path(config).stem)
        name = _registered(self.own)
        what = scenarios.SCENARIOS[name][1] if name in scenarios.SCENARIOS else ""
        found = scenarios.get(name, **changes)
        return Described(found, [f"Scenario {printable(name)}: {printable(what or type(found).__name__)}"])


def _parameters(options: StreamOptions, *names: str) -> dict[str, Any]:
    """The scenario's parameters that the user gave by these options, under the scenario's names for them."""
    from bufgym.scenario.checks import names_in

    parameters = {_PARAMETERS.get(name, name): value for name, value in given(options, *names).items()}
    holes = parameters.pop("holes", None)
    if holes is not None:
        if options.trace is None:
            raise BufgymError("--holes needs --trace")
        parameters["traces"] = [_over_holes(name, holes) for text in options.trace for name in names_in(text)]
    return parameters


def _over_holes(name: str, holes: Holes) -> Trace | str:
    """The trace of a file; what is no file has no holes."""
    from bufgym import traces

    return traces.read_trace(name, holes=holes) if Path(name).is_file() else name


def _registered(options: OwnOptions) -> str:
    """The name of the scenario, after the file that registers it was run."""
    from bufgym.scenario import SCENARIOS

    before, name = dict(SCENARIOS), options.scenario
    if options.scenario_file is not None:
        modules.run_file(options.scenario_file, "--scenario-file")
    added = [key for key, entry in SCENARIOS.items() if before.get(key) is not entry]
    if name is None and len(added) != 1:
        names = f"registers {', '.join(added)}: choose by --scenario" if added else "registers no scenario"
        raise BufgymError(f"{options.scenario_file}: {names}")
    return name or added[0]


def _uplink(stream: StreamOptions, measured: MotionOptions) -> Described:
    from bufgym import scenario as scenarios
    from bufgym.model import qoi

    settings = _parameters(stream)
    if stream.motion is not None:
        settings["motion"] = _motions(stream.motion, measured)
    if stream.motion == ["none"]:
        settings = {"value": qoi.exponential(), **settings}
    scenario: Any = scenarios.get("lte", **settings)
    named = [*(scenario.traces if stream.trace else ()), *(scenario.motion if stream.motion else ())]
    facts = [
        f"{printable(one.name)}: {'; '.join(f'{name} {value}' for name, value in one.sheet.facts)}"
        for one in named[:_MOST_FACTS]
        if one.sheet.facts
    ]
    return Described(scenario, facts=facts)


def recorded(files: Sequence[str], stream: StreamOptions, recording: RecordingOptions, seeds: int | None) -> Described:
    """Make a workload as recorded; with --seeds it starts at random places of each trace."""
    from bufgym import scenario as scenarios
    from bufgym.model import qoi
    from bufgym.traces import read_workload

    refuse(given(stream, *_MESSAGES), "cannot go with --workload: a recording has its own")
    with bar(None, True, "message") as advance:
        workload = read_workload(files, **recording.arguments(), advance=advance)
    motions = _motions(stream.motion or [], recording)
    if recording.odom is None and not motions:
        refuse(given(recording, *MOTION), "needs --odom or --motion")
    by_motion = bool(motions) or workload.x is not None
    settings: dict[str, Any] = {
        "value": qoi.exponential(math.exp(-1)) if by_motion else qoi.exponential(),
        **_parameters(stream, "trace", "scale", "holes", "tells_duration", "value"),
        **{"motion": motions, "random_offset": seeds is not None, "workload": workload},
    }
    lines = [printable(workload.source), "", *workload_lines(workload), ""]
    return Described(scenarios.get("lte", **settings), lines, recorded=True)


def _motions(names: Sequence[str], measured: MotionOptions) -> tuple[Motion, ...]:
    """Load motions by shipped name or from files, measured as the options say; ``["none"]`` gives none."""
    from bufgym import traces
    from bufgym.scenario.checks import names_in
    from bufgym.traces.formats.motions import MOTION_HEADER

    settings, motions = measured.settings(), []
    for name in () if list(names) == ["none"] else [name for text in names for name in names_in(text)]:
        if settings is None:
            motions.append(traces.load_motion(name))
            continue
        with bar(None, True, "line") as advance:
            motions.append(traces.read_motion(traces.shipped().get(name, name), settings, advance=advance))
        if motions[-1].source.endswith(f"({MOTION_HEADER})"):
            refuse(given(measured, *MOTION), f"cannot go with {name}, which holds finished coordinates")
    return tuple(motions)

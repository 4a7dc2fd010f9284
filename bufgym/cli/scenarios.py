"""Scenario that options describe: a named one with its stream and links, or a recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cyclopts import Group, Parameter

from bufgym.cli.options import Bytes, Holes, Positive, given, refuse
from bufgym.cli.trace_bags import MotionOptions, RecordingOptions, workload_lines
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError, printable
from bufgym.utils.progress import bar

if TYPE_CHECKING:
    from bufgym.traces import Trace

_PARAMETERS = {"trace": "traces", "fps": "rate_hz", "bytes": "size_bytes", "seconds": "duration_s"}
"""Options whose scenario parameter has another name. Options not given take the scenario's defaults, and text is read
there."""

_MESSAGES = ("fps", "bytes", "sizes", "seconds")
"""Options of a made stream, which a recording has itself."""

_MOST_FACTS = 3  # Recordings whose facts stand above a table
DEFAULT = "lte"


@Parameter(name="*", group=Group.create_ordered("The scenario, its stream and its link (default: bufgym/Uplink-v1's)"))
@dataclass(frozen=True)
class StreamOptions:
    scenario: str | None = None
    """Which ('bufgym list scenarios'), with parameters as in lte:jitter=0.2,scale=0.5; module:function; or a client's
    topics and their rules, as in examples/client.toml:window=5."""
    scenario_file: str | None = None
    """A Python file that registers it; its code is run."""
    trace: list[str] | None = None
    """Bandwidth traces, as in a,b or a b: files, shipped names, a rate as in 20Mbit/s, or module:function, a seed ->
    Trace (default: shipped LTE)."""
    motion: list[str] | None = None
    """Motion recordings, likewise (default: shipped drives); 'none': x is the frame index."""
    holes: Holes | None = None
    """Where a trace has no samples: hold the rate before (default), send nothing, or refuse the file."""
    fps: Positive | None = None
    """Messages a second (default: 30)."""
    bytes: Bytes | None = None
    """Mean message size, bytes, or with a unit as in 4.6MB (default: 4608000; of an interruption: 230000)."""
    sizes: str | None = None
    """Law of the sizes: jpeg, gop, depth-colour, motion, recorded:NAME; with parameters jpeg:cv=0.3 (default:
    equal)."""
    seconds: Positive | None = None
    """Length of an episode, s (default: 30)."""
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

    def arguments(self, measured: MotionOptions | None = None) -> dict[str, Any]:
        """Collect those given for ``read_workload``."""
        if self.columns is None:
            refuse(given(self, "time_unit"), "needs --columns")
            return super().arguments(measured)
        from bufgym.traces import Columns

        if len(self.columns) not in (2, 3):
            raise BufgymError(f"--columns {' '.join(self.columns)}: must be TIME BYTES or TIME BYTES TOPIC")
        time, size, topic = [*self.columns, ""][:3]
        chosen = Columns(time, bytes=size, topic=topic, time_unit=self.time_unit or "")
        return {**super().arguments(measured), "columns": chosen}


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


def described(stream: StreamOptions, workload: WorkloadOptions, seeds: int | None) -> Described:
    """Make the scenario; ``seeds`` is None where the user gave none."""
    if workload.workload is not None:
        return recorded(workload.workload, stream, workload, seeds)
    refuse(given(workload), "needs --workload")
    return _named(stream)


def _named(stream: StreamOptions) -> Described:
    """The scenario by name, after the file that registers it was run, or the client of a file; else the default."""
    from bufgym import scenario as scenarios
    from bufgym.model import qoi

    is_named = bool(given(stream, "scenario", "scenario_file"))
    name = _registered(stream) if is_named else DEFAULT
    scenario: Any = scenarios.get(name)
    changes, known = _parameters(stream), scenarios.registry.parameters(scenario)
    foreign = {option: 0 for option in given(stream, *_OF_A_SCENARIO) if _PARAMETERS.get(option, option) not in known}
    refuse(foreign, f"cannot go with {printable(name)}, which has no such parameter")
    if stream.motion == ["none"]:
        changes = {"value": qoi.exponential(), **changes}
    scenario = scenarios.get(scenario, **changes)
    recordings = [*(scenario.traces if stream.trace else ()), *(scenario.motion if stream.motion else ())]
    facts = [
        f"{printable(one.name)}: {'; '.join(f'{name} {value}' for name, value in one.sheet.facts)}"
        for one in recordings[:_MOST_FACTS]
        if one.sheet.facts
    ]
    plain = name.partition(":")[0]
    if plain.endswith(".toml"):
        return Described(scenario, [f"The client of {printable(name)}."], Path(plain).stem, facts=facts)
    what = scenarios.SCENARIOS[plain][1] if plain in scenarios.SCENARIOS else type(scenario).__name__
    lines = [f"Scenario {printable(name)}: {printable(what)}"] if is_named else []
    return Described(scenario, lines, facts=facts)


_OF_A_SCENARIO = ("trace", "motion", *_MESSAGES, "value")


def _parameters(options: StreamOptions, *names: str) -> dict[str, Any]:
    """The scenario's parameters that the user gave by these options, under the scenario's names for them."""
    from bufgym.scenario.checks import names_in

    found = given(options, *(names or _OF_A_SCENARIO))
    parameters = {_PARAMETERS.get(name, name): value for name, value in found.items()}
    if options.holes is not None:
        if options.trace is None:
            raise BufgymError("--holes needs --trace")
        parameters["traces"] = [_over_holes(name, options.holes) for text in options.trace for name in names_in(text)]
    return parameters


def _over_holes(name: str, holes: Holes) -> Trace | str:
    """The trace of a file; what is no file has no holes."""
    from bufgym import traces

    return traces.read_trace(name, holes=holes) if Path(name).is_file() else name


def _registered(options: StreamOptions) -> str:
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


def recorded(files: Sequence[str], stream: StreamOptions, recording: RecordingOptions, seeds: int | None) -> Described:
    """Make a workload as recorded; with --seeds it starts at random places of each trace."""
    from bufgym import scenario as scenarios
    from bufgym.model import qoi
    from bufgym.traces import read_workload

    refuse(given(stream, *_MESSAGES, "scenario_file"), "cannot go with --workload: a recording has its own")
    name = stream.scenario or DEFAULT
    base = scenarios.get(name)
    if "workload" not in scenarios.registry.parameters(base):
        raise BufgymError(f"--workload cannot go with {printable(name)}, which plays no recording")
    with bar(None, True, "message") as advance:
        workload = read_workload(files, **recording.arguments(), advance=advance)
    motion = "none" if stream.motion in (None, ["none"]) else stream.motion
    by_motion = motion != "none" or workload.x is not None
    settings: dict[str, Any] = {
        "value": qoi.exponential(math.exp(-1)) if by_motion else qoi.exponential(),
        **_parameters(stream, "trace", "value"),
        **{"motion": motion, "random_offset": seeds is not None, "workload": workload},
    }
    lines = [printable(workload.source), "", *workload_lines(workload), ""]
    return Described(scenarios.get(base, **settings), lines, recorded=True)

"""``bufgym trace generate``: links, motions and workloads from a seed.

A link's options are the parameters of the function that makes it, without their units.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from bufgym import traces
from bufgym.cli.options import Bytes, Natural, Positive, Rate
from bufgym.traces import Trace


def _option(name: str) -> str:
    """Take off the unit: ``mean_good_s`` is ``--mean-good``; ``bytes_per_s`` is ``--rate``."""
    return "rate" if name == "bytes_per_s" else re.sub("_(bytes_per_s|m_per_s|bytes|s|m)$", "", name).replace("_", "-")


generate = App(
    name="generate",
    help="Make a link, a motion or a workload from a seed, as CSV.",
    default_parameter=Parameter(name_transform=_option),
)
Out = Annotated[Path, Parameter(alias="-o", help="The CSV to write.")]
TYPES: Mapping[str, Any] = {
    "seed": Natural,
    **dict.fromkeys(("bytes_per_s", "start_bytes_per_s", "end_bytes_per_s"), Rate),
    "links": Annotated[Any, Parameter(converter=lambda _, tokens: traces.read_links(tokens[0].value), n_tokens=1)],
}
"""Types of parameters that are not as the function says."""
DEFAULTS: Mapping[str, Any] = {
    **{"seed": 0, "bytes_per_s": 10e6},
    **{"start_bytes_per_s": 12.5e6, "end_bytes_per_s": 0.5e6},  # Robofleet's
}


def _link(name: str, about: str, make: Callable[..., Trace]) -> None:
    """Add the command of a function that makes a link."""

    def command(**settings: Any) -> None:
        out = settings.pop("out")
        trace = make(**{**defaults, **settings})
        traces.write_csv(trace, out)
        print(f"wrote {out}: {trace.source}, mean {trace.mean_bytes_per_s / 1e6:.3f} MB/s")

    only, its_own = inspect.Parameter.KEYWORD_ONLY, inspect.signature(make, eval_str=True).parameters
    defaults = {key: DEFAULTS[key] for key in its_own if key in DEFAULTS}
    parameters = [inspect.Parameter("out", only, annotation=Out)]
    for key, given in its_own.items():
        default, annotation = DEFAULTS.get(key, given.default), TYPES.get(key, given.annotation)
        parameters.append(inspect.Parameter(key, only, default=default, annotation=annotation))
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__doc__ = f"{about}\n\n{inspect.getdoc(make)}"
    generate.command(command, name=name)


_link("link", "A mobile link as recorded in trams, trains, ... (or in WiFi).", traces.markov_link)
_link("ramp", "A rate that changes evenly.", traces.ramp)
_link("tunnel", "Steady, fade, blackout, fade in, steady.", traces.tunnel)


@generate.command
def drive(*, seed: Natural = 0, duration: Positive = 300.0, out: Out) -> None:
    """The motion of a robot that cruises, turns in place and stops.

    Args:
        duration: Length, s.
    """
    motion = traces.drive_motion(seed, duration)
    traces.write_motion_csv(motion, out)
    print(f"wrote {out}: {motion.source}, {motion.total:.3f} views")


@generate.command
def workload(
    *,
    seed: Natural = 0,
    duration: Positive = 300.0,
    fps: Positive = 30.0,
    bytes: Bytes = 230_000,
    sizes: str = "equal",
    motion: str = "drive-0",
    out: Out,
) -> None:
    """The messages of a camera, for ``--workload`` of bench.

    Args:
        duration: Length, s.
        fps: Messages a second.
        bytes: Mean size of a message.
        sizes: Law of the sizes: equal, jpeg, gop, depth-colour, motion, recorded:NAME; with parameters jpeg:cv=0.3.
        motion: Recording that gives x from a random place on; 'none': without x.
    """
    from bufgym import scenario
    from bufgym.scenario import Streams

    uplink = scenario.get("lte", rate_hz=fps, size_bytes=bytes, sizes=sizes, motion=motion, duration_s=duration)
    drawn = uplink.draw(Streams.seeded(seed)).arrivals
    x = None if motion == "none" else drawn["x"]
    made = traces.Workload("made", drawn["arrival_us"], drawn["size_bytes"], x=x)
    traces.write_workload_csv(made, out)
    print(f"wrote {out}: {len(made)} messages, mean {made.size_bytes.mean():,.0f} bytes")

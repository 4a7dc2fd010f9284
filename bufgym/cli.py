"""The command ``bufgym``. Thin: each subcommand reads its options and calls the room that does the work.

Whatever is heavy is imported inside the subcommand that needs it. A mistake of the caller's (an option, a file) ends
in one line on stderr and exit code 2; Ctrl-C in 130.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from bufgym import __version__
from bufgym.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.scenario import Scenario

KINDS = ("environments", "scenarios", "policies", "values", "rewards", "observations", "traces")

DEFAULTS = {
    "fps": 30.0,
    "bytes": 230_000,
    "seconds": 60.0,
    "jitter": 0.1,
    "size_cv": 0.0,
    "scale": 1.0,
    "t_min": 1,
    "t_max": 400,
    "t_mean": 100.0,
    "law": "log-uniform",
}
"""What ``bench`` takes where an option is not given (fps 1/s, bytes and seconds as named, t_* messages)."""

_UPLINK_ONLY = ("trace", "motion", "seconds", "jitter", "size_cv", "scale")
_INTERRUPTION_ONLY = ("t_min", "t_max", "t_mean", "law")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit code."""
    files: list[str] = []
    try:
        options = _parser().parse_args(arguments)
        files = [options.policy_file] if getattr(options, "policy_file", None) else []
        options.command(options)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader (head, less) has gone; what the interpreter flushes at its end has nowhere to go either.
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        return 130
    except BufgymError as error:
        return _failed(str(error))
    except OSError as error:
        named = f"{error.filename}: " if error.filename is not None else ""
        return _failed(f"{named}{error.strerror or error}")
    except Exception as error:
        place = _line_in(error, files)
        if place is None and files and _from_numba(error):
            return _failed(f"{files[0]}: a policy with compile=True that Numba cannot compile: {_gist(error)}")
        if place is None:
            raise
        return _failed(f"{place}: {type(error).__name__}: {error}")
    return 0


def _failed(message: str) -> int:
    print(f"bufgym: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _line_in(error: Exception, files: Sequence[str]) -> str | None:
    """Where in the user's own file it went wrong ("mine.py, line 3"), or None if it was elsewhere."""
    found, trail = None, error.__traceback__
    while trail is not None:
        name = trail.tb_frame.f_code.co_filename
        found = next((f"{file}, line {trail.tb_lineno}" for file in files if _same(file, name)), found)
        trail = trail.tb_next
    return found


def _from_numba(error: Exception) -> bool:
    return type(error).__module__.startswith("numba.")


def _gist(error: Exception) -> str:
    """The part of Numba's many lines that tells most: what it did not know, and the line of the source."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    # "File "mine.py", line 4:" comes last of all.
    place = [line.rstrip(":") for line in lines if line.startswith("File ")][-1:]
    telling = [line for line in lines if not line.startswith(("Failed in", "During:", "File ", "-", "^", "<"))][:1]
    # Written out, the type of a buffer has some twenty fields.
    return re.sub(r"\bBuffer\(.*\)", "Buffer", "; ".join([*telling, *place]))


def _same(file: str, name: str) -> bool:
    return os.path.abspath(file) == os.path.abspath(name)


# --- options ---------------------------------------------------------------------------------------------------------


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise BufgymError(f"{message} (see {self.prog} --help)")


def _number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r}: must be a finite number")
    return number


def _positive(text: str) -> float:
    number = _number(text)
    if number <= 0:
        raise argparse.ArgumentTypeError(f"{text}: must be a number > 0")
    return number


def _least_0(text: str) -> float:
    number = _number(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text}: must be a number >= 0")
    return number


def _count(text: str) -> int:
    number = _natural(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number >= 1")
    return number


def _natural(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        number = -1
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number >= 0")
    return number


def _capacities(text: str) -> list[int]:
    numbers = [_count(part) for part in text.split(",")]
    for number in numbers:
        if numbers.count(number) > 1:
            raise argparse.ArgumentTypeError(f"{text}: {number} is given more than once")
    return numbers


def split_policies(text: str) -> list[str]:
    """``"afr,decimate:every=2,random"`` -> its three policies; a setting belongs to the policy before it."""
    specs: list[str] = []
    for part in text.split(","):
        if "=" in part and ":" not in part and specs:
            specs[-1] += f",{part}"
        else:
            specs.append(part.strip())
    return specs


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="bufgym", description="A robot's send buffer is full: which message should go?")
    parser.add_argument("--version", action="version", version=f"bufgym {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(name: str, function: Callable[[argparse.Namespace], None], help: str, to: Any = commands) -> Any:
        made = to.add_parser(name, help=help, description=help[0].upper() + help[1:] + ".")
        made.set_defaults(command=function)
        return made

    listing = command("list", _list, "what there is: environments, scenarios, policies and more")
    listing.add_argument("what", nargs="?", choices=KINDS, metavar="KIND", help=f"only one of: {', '.join(KINDS)}")
    _policy_file(listing)

    _bench_options(command("bench", _bench, "run policies side by side on the same episodes"))

    trace = commands.add_parser("trace", help="look at bandwidth traces", description="Look at bandwidth traces.")
    verbs = trace.add_subparsers(title="verbs", metavar="VERB", required=True)
    info = command("info", _trace_info, "statistics of bandwidth traces", verbs)
    plot = command("plot", _trace_plot, "draw bandwidth traces (needs the extra 'plot')", verbs)
    for made in (info, plot):
        made.add_argument("files", nargs="+", metavar="FILE", help="a file or a shipped name")
    plot.add_argument("--out", required=True, metavar="FILE", help="the picture to write: .png, .svg or .pdf")

    reproduce = command("reproduce", _reproduce, "figures and tables of the papers, our number beside theirs")
    reproduce.add_argument("names", nargs="*", metavar="NAME", help="which; 'all' for all; none lists them")
    reproduce.add_argument("--out", default="reproduced", metavar="DIR", help="where pictures go (%(default)s)")

    perf = command("perf", _perf, "measure bufgym's own speed on this machine")
    perf.add_argument("--json", metavar="FILE", help="also write the figures to FILE")
    perf.add_argument("--repeats", type=_count, default=3, help="best of so many (%(default)s)")
    perf.add_argument("--quick", action="store_true", help="tiny sizes: does it run at all?")

    play = command("play", _play, "watch a policy decide, in the terminal")
    play.add_argument("--policy", default="afr", help="policy, as in bench (%(default)s)")
    play.add_argument("--env", default="Uplink-v0", help="environment (%(default)s)")
    play.add_argument("--capacity", type=_count, default=8, metavar="L", help="L, messages (%(default)s)")
    play.add_argument("--seed", type=_natural, default=0, help="which episode: that of bench's seed (%(default)s)")
    play.add_argument("--speed", type=_least_0, default=5.0, help="decisions a second; 0: no pause (%(default)s)")
    play.add_argument("--steps", type=_count, default=200, help="stop after so many decisions (%(default)s)")
    _policy_file(play)
    return parser


def _policy_file(parser: Any) -> None:
    parser.add_argument(
        "--policy-file",
        metavar="FILE.py",
        help="a Python file that registers policies of your own; its code is run, so use only files you trust",
    )


def _bench_options(bench: argparse.ArgumentParser) -> None:
    who = bench.add_argument_group("who runs")
    add = who.add_argument
    add("--policies", metavar="A,B:x=1,C", help="policies, with settings as in decimate:every=2 (default: all)")
    add("--capacity", type=_capacities, default=[8], metavar="L,...", help="capacities L, messages (default: 8)")
    add("--max-bytes", type=_count, metavar="B", help="also at most B bytes queued (default: no limit)")
    add("--decide-at", choices=("arrival", "overflow"), default="arrival", help="ask at every arrival, or when full")
    add("--seeds", type=_count, default=10, metavar="N", help="episodes a trace: seeds 0..N-1 (default: 10)")
    _policy_file(who)
    add = bench.add_argument_group("the stream and its link").add_argument
    add("--trace", nargs="+", metavar="FILE", help="bandwidth traces, files or shipped names (default: shipped LTE)")
    add("--motion", nargs="+", metavar="FILE", help="motion recordings, likewise; 'none': x is the frame index")
    add("--fps", type=_positive, help=f"messages a second (default: {DEFAULTS['fps']:g})")
    add("--bytes", type=_count, help=f"mean message size, bytes (default: {DEFAULTS['bytes']})")
    add("--size-cv", type=_least_0, help="coefficient of variation of the size (default: 0, all equal)")
    add("--seconds", type=_positive, help=f"length of an episode, s (default: {DEFAULTS['seconds']:g})")
    add("--jitter", type=_least_0, help=f"arrivals move by up to this part of a period (default: {DEFAULTS['jitter']})")
    add("--scale", type=_positive, help="multiply the link's capacity (default: 1)")
    add(
        "--value",
        metavar="V",
        help="V of the QoI: exponential:BASE or saturating:DISTANCE"
        " (default: exponential:0.367879 over motion, exponential:0.618 over frame indices)",
    )
    add = bench.add_argument_group("one interruption of unknown length T instead").add_argument
    add("--interruption", action="store_true", help="this scenario, and regret against its oracle")
    add("--law", help="of T: fixed (t-max), uniform, log-uniform, geometric (default: log-uniform)")
    add("--t-min", type=_count, metavar="T", help="shortest, messages (default: 1)")
    add("--t-max", type=_count, metavar="T", help="longest, messages (default: 400)")
    add("--t-mean", type=_positive, metavar="T", help="mean of the geometric law (default: 100)")
    add = bench.add_argument_group("where results go").add_argument
    add("--out", metavar="DIR", help="write rows.parquet (rows.csv without pyarrow) and table.md there")
    add("--format", choices=("csv", "parquet"), help="format of the rows")


# --- list ------------------------------------------------------------------------------------------------------------


def _list(options: argparse.Namespace) -> None:
    _load_policies(options.policy_file)
    sections = [f"{kind}\n{_LISTS[kind]()}" for kind in KINDS if options.what in (None, kind)]
    print("\n\n".join(sections))


def _columns(lines: Sequence[Sequence[str]]) -> str:
    """Left-aligned columns, indented; the last is not padded."""
    widths = [max((len(line[c]) for line in lines), default=0) for c in range(max(map(len, lines), default=0))]
    return "\n".join(
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def environments() -> dict[str, str]:
    """Id -> scenario of every environment that bufgym has registered with Gymnasium."""
    import gymnasium

    specs = [spec for spec in gymnasium.registry.values() if spec.namespace == "bufgym"]
    return {spec.id: str(spec.kwargs.get("scenario", "")) for spec in specs}


def _list_environments() -> str:
    from bufgym.scenario import SCENARIOS

    def what(scenario: str) -> str:
        return SCENARIOS[scenario][1] if scenario in SCENARIOS else ""

    return _columns([(id, f"scenario {scenario}", what(scenario)) for id, scenario in sorted(environments().items())])


def _list_scenarios() -> str:
    from bufgym.scenario import SCENARIOS

    return _columns([(name, meaning) for name, (_, meaning) in SCENARIOS.items()])


def _list_policies() -> str:
    from bufgym import policies

    lines = []
    width = max(map(len, policies.names()))
    for name in policies.names():
        policy = policies.get(name)
        lines.append(f"  {name:<{width}}  {policy.summary}".rstrip())
        settings = ", ".join(f"{setting}={policy.memory[setting]:g}" for setting in policy.parameters)
        if settings:
            lines.append(f"  {'':<{width}}  settings: {settings}")
        lines.append(f"  {'':<{width}}  from: {policy.source or 'a policy file'}")
    return "\n".join(lines)


def _list_values() -> str:
    from bufgym import qoi

    return _columns(
        [
            ("exponential:BASE", _first_line(qoi.exponential)),
            ("saturating:DISTANCE", _first_line(qoi.saturating)),
            ("(Python only)", f"bufgym.qoi.tabulated: {_first_line(qoi.tabulated)}"),
        ]
    )


def _first_line(function: Any) -> str:
    return (function.__doc__ or "").strip().split("\n")[0]


def _list_rewards() -> str:
    from bufgym.observe import REWARD_TERMS

    return _columns([(term.name, term.unit, term.meaning) for term in REWARD_TERMS])


def _list_observations() -> str:
    from bufgym.observe import FIELDS

    return _columns([(f.name, f.per, f.group, f.unit, f.meaning) for f in FIELDS])


def _list_traces() -> str:
    from bufgym.traces import shipped

    kinds = {"lte": "bandwidth, synthetic LTE", "drive": "motion of a driving robot, synthetic"}
    found = shipped()
    return _columns([(name, kinds.get(name.split("-")[0], "")) for name in found]) if found else "  none found"


_LISTS: dict[str, Callable[[], str]] = {
    "environments": _list_environments,
    "scenarios": _list_scenarios,
    "policies": _list_policies,
    "values": _list_values,
    "rewards": _list_rewards,
    "observations": _list_observations,
    "traces": _list_traces,
}


# --- bench -----------------------------------------------------------------------------------------------------------


def _bench(options: argparse.Namespace) -> None:
    from bufgym import policies
    from bufgym.benchmark import run, table

    _load_policies(options.policy_file)
    specs = split_policies(options.policies) if options.policies is not None else list(policies.names())
    chosen = [policies.get(spec) for spec in specs]
    form = options.format or ("parquet" if run.has_pyarrow() else "csv")
    if form == "parquet" and options.out is not None and not run.has_pyarrow():
        raise BufgymError('--format parquet needs pyarrow: pip install "bufgym[bench]" (or --format csv)')
    scenario, about = _scenario(options)
    if options.out is not None:
        # Before the long work, so that a folder that cannot be made is known at once.
        Path(options.out).mkdir(parents=True, exist_ok=True)
    rows = run.run(
        chosen,
        scenario,
        options.capacity,
        options.seeds,
        max_bytes=options.max_bytes,
        decide_at=options.decide_at,
        progress=True,
    )
    print(f"{about}\n\n{table.plain(rows)}")
    if options.out is not None:
        written = run.write_rows(rows, Path(options.out) / f"rows.{form}")
        target = Path(options.out) / "table.md"
        with run.replaced(target) as temporary:
            temporary.write_text(f"{about}\n\n{table.markdown(rows)}\n", encoding="utf-8")
        print(f"\n{len(rows)} rows in {written}, this table in {target}")


def _scenario(options: argparse.Namespace) -> tuple[Scenario, str]:
    """The scenario that the options of ``bench`` describe, and a sentence about it."""
    unused = _UPLINK_ONLY if options.interruption else _INTERRUPTION_ONLY
    for name in unused:
        if getattr(options, name) is not None:
            only = "cannot go with" if options.interruption else "needs"
            raise BufgymError(f"--{name.replace('_', '-')} {only} --interruption")
    take = {
        name: default if getattr(options, name) is None else getattr(options, name)
        for name, default in DEFAULTS.items()
    }
    return _interruption(options, take) if options.interruption else _uplink(options, take)


def _interruption(options: argparse.Namespace, take: dict[str, Any]) -> tuple[Scenario, str]:
    from bufgym import qoi
    from bufgym.scenario import Interruption

    made = Interruption(
        law=take["law"],
        t_min=take["t_min"],
        t_max=take["t_max"],
        t_mean=take["t_mean"],
        rate_hz=take["fps"],
        size_bytes=take["bytes"],
        value=qoi.parse(options.value) if options.value is not None else qoi.exponential(),
    )
    length = f"T = {made.t_max}" if made.law == "fixed" else f"T {made.law} on {made.t_min}..{made.t_max}"
    about = f"One interruption of T messages, {length}; V = {made.value.name} over frame indices."
    return made, f"{about}\nMeans over {options.seeds} seeds. Regret = 1 - (QoI - 1) / oracle."


def _uplink(options: argparse.Namespace, take: dict[str, Any]) -> tuple[Scenario, str]:
    from bufgym import qoi, traces
    from bufgym.scenario import Uplink

    names = traces.shipped()
    links = options.trace if options.trace is not None else [name for name in names if name.startswith("lte-")]
    motions = options.motion if options.motion is not None else [name for name in names if name.startswith("drive-")]
    if motions == ["none"]:
        motions = []
    default = qoi.exponential(math.exp(-1)) if motions else qoi.exponential()
    made = Uplink(
        traces=tuple(traces.load(name) for name in links),
        motion=tuple(traces.load_motion(name) for name in motions),
        rate_hz=take["fps"],
        jitter=take["jitter"],
        size_bytes=take["bytes"],
        size_cv=take["size_cv"],
        duration_s=take["seconds"],
        scale=(take["scale"],),
        value=qoi.parse(options.value) if options.value is not None else default,
    )
    recorded = _some([motion.name for motion in made.motion])
    over = f"the camera's motion, in fields of view, from {recorded}" if motions else "the frame index"
    scaled = f" x {take['scale']:g}" if take["scale"] != 1 else ""
    about = [
        f"{take['fps']:g} messages/s of {take['bytes']} bytes for {take['seconds']:g} s"
        f" over {_some([trace.name for trace in made.traces])}{scaled}, from random offsets.",
        f"QoI = 1 + sum of V(step in x) over the messages received; V = {made.value.name}.",
        f"x is {over}.",
        f"Means over {len(made.traces)} {'trace' if len(made.traces) == 1 else 'traces'} x {options.seeds} seeds;"
        " every policy meets the same episodes.",
    ]
    return made, "\n".join(about)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} .. {names[-1]}"


def _load_policies(path: str | None) -> None:
    """Run the user's Python file, which registers policies."""
    if path is None:
        return
    import importlib.util

    if not Path(path).is_file():
        raise BufgymError(f"{path}: no such file (--policy-file)")
    spec = importlib.util.spec_from_file_location(f"bufgym_policy_file_{Path(path).stem}", path)
    if spec is None or spec.loader is None:
        raise BufgymError(f"{path}: must be a Python file, named .py")
    module = importlib.util.module_from_spec(spec)
    # Compiled functions are pickled by their module's name.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise BufgymError(f"{path}, line {error.lineno}: {error.msg}") from None


# --- trace, reproduce, perf, play ------------------------------------------------------------------------------------


def _trace_info(options: argparse.Namespace) -> None:
    from bufgym import traces

    blocks = []
    for name in options.files:
        trace = traces.load(name)
        lines = [
            (key, f"{number:,.6g}" if number < 1e6 else f"{number:,.0f}")
            for key, number in traces.describe(trace).items()
        ]
        knots = ("knots", f"{len(trace.time_us)}")
        blocks.append(f"{trace.name}\n" + _columns([("source", trace.source), knots, *lines]))
    print("\n\n".join(blocks))


def _trace_plot(options: argparse.Namespace) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise BufgymError('drawing needs matplotlib: pip install "bufgym[plot]"') from None
    import numpy as np

    from bufgym import traces

    out = Path(options.out)
    if out.suffix not in (".png", ".svg", ".pdf"):
        raise BufgymError(f"--out {out}: must end in .png, .svg or .pdf")
    loaded = [traces.load(name) for name in options.files]
    figure = Figure(figsize=(9, 1.2 + 1.8 * len(loaded)), layout="constrained")
    axes = figure.subplots(len(loaded), 1, squeeze=False)[:, 0]
    for axis, trace in zip(axes, loaded, strict=True):
        lengths_us, rates = trace.samples()
        edges_s = np.concatenate([[0], np.cumsum(lengths_us)]) / 1e6
        axis.stairs(rates / 1e6, edges_s, fill=True, alpha=0.6)
        axis.set_title(trace.name, fontsize="medium", loc="left")
        axis.set_ylabel("MB/s")
        axis.set_xlim(0, edges_s[-1])
        axis.set_ylim(bottom=0)
    axes[-1].set_xlabel("time (s)")
    figure.savefig(out)
    print(f"wrote {out}")


def _reproduce(options: argparse.Namespace) -> None:
    from bufgym import reproduce

    if not options.names:
        print("figures (bufgym reproduce NAME..., or all)\n" + _columns(list(reproduce.FIGURES.items())))
        return
    for name in options.names:
        if name != "all" and name not in reproduce.FIGURES:
            raise BufgymError(f"unknown figure {name!r}; known: all, {', '.join(reproduce.FIGURES)}")
    names = list(reproduce.FIGURES) if "all" in options.names else list(dict.fromkeys(options.names))
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        print(("\n" if k else "") + reproduce.run(name, out), flush=True)


def _perf(options: argparse.Namespace) -> None:
    from bufgym.benchmark import perf

    sizes = perf.Sizes(repeats=options.repeats)
    if options.quick:
        sizes = perf.Sizes(4, 4, 20, 5, 20, 1, options.repeats)
    elif sys.stderr.isatty():
        print("measuring; this takes about half a minute ...", file=sys.stderr)
    figures = perf.measure(sizes)
    print(perf.report(figures, sizes.repeats))
    if options.json is not None:
        perf.write_json(figures, sizes, Path(options.json))


def _play(options: argparse.Namespace) -> None:
    import time

    import gymnasium

    from bufgym import policies
    from bufgym.benchmark.play import Player
    from bufgym.benchmark.run import draw

    _load_policies(options.policy_file)
    policy = policies.get(options.policy)
    known = environments()
    id = options.env if "/" in options.env else f"bufgym/{options.env}"
    if id not in known:
        raise BufgymError(f"unknown environment {options.env!r}; known: {', '.join(sorted(known))}")
    env: Any = gymnasium.make(id, capacity=options.capacity, render_mode="ansi").unwrapped
    player = Player(policy)
    env.reset(options={"episode": draw(env.rows.scenario, options.seed)})
    # On a terminal each picture takes the place of the one before.
    clear = "\x1b[H\x1b[J" if sys.stdout.isatty() else ""
    for step in range(options.steps):
        print(f"{clear}{policy.name}, decision {step + 1}\n{env.render()}", flush=True)
        if options.speed:
            time.sleep(1 / options.speed)
        # An episode that asks for no decision ends with its first step, whatever the action.
        due = env.rows.senders.batch.senders[0]["waiting"] == 1
        _, _, ended, _, info = env.step(player.action(env.rows.senders, 0) if due else options.capacity)
        if ended:
            print(
                f"{env.render()}\nover: QoI {info['qoi']:.3f}, {info['delivered']} of {info['arrived']} delivered,"
                f" {info['dropped']} dropped"
            )
            return
    print(f"stopped after {options.steps} decisions (--steps)")


if __name__ == "__main__":
    sys.exit(main())

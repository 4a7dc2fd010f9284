"""``bufgym trace``: describe, plot and convert bandwidth traces. Other verbs have modules of their own."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from bufgym.cli.options import Holes, columns
from bufgym.utils.errors import BufgymError, TraceError, printable
from bufgym.utils.libraries import library

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from bufgym.traces import Columns, Trace

_PICTURES = (".png", ".svg", ".pdf")
_MOST_DRAWN = 5_000  # most rates in a picture some 1300 pixels wide; more rates are averaged over this many windows


Files = Annotated[list[str], Parameter(help="A file, or a shipped name.")]


@Parameter(name="*")
@dataclass(frozen=True)
class ReadOptions:
    format: str | None = None
    """The files' format (default: detected)."""
    column: str | None = None
    """Of UCC files (DL_bitrate, UL_bitrate), of iperf3 --bidir (upload, download), or which run of a list."""
    holes: Holes = "hold"
    """Stretches without samples: hold the rate before, send nothing ("zero"), or refuse."""

    def load(self, name: str, columns: Columns | None = None) -> Trace:
        """The trace of this name or file."""
        from bufgym import traces

        return traces.load(name, self.format, column=self.column, columns=columns, holes=self.holes)


@Parameter(name="*")
@dataclass(frozen=True)
class ColumnOptions:
    time: str | None = None
    """Of any table: the column of times, by name or number; with --rate."""
    rate: str | None = None
    """The column of rates."""
    unit: str = "bit/s"
    """Unit of the rates: B/s, kB/s, Mbit/s, ..."""
    time_unit: str = ""
    """Unit of the times: s, ms, us, ns (default: that in the column's name, else s)."""

    def chosen(self) -> Columns | None:
        """The columns of a table; None where the file's format says them."""
        from bufgym import traces

        if self.time is not None and self.rate is not None:
            return traces.Columns(self.time, self.rate, self.unit, self.time_unit)
        if self.time != self.rate:
            raise BufgymError("--time and --rate go together")
        return None


def info(files: Files, /, *, read: ReadOptions = ReadOptions()) -> int:
    """Print statistics of bandwidth traces; exit code 2 if one is not sound."""
    from bufgym import traces

    failed = 0
    for k, name in enumerate(files):
        try:
            trace = read.load(name)
        except TraceError as error:
            failed += 1
            print(f"bufgym: error: {error}", file=sys.stderr)
            continue
        lines = [
            (key, f"{number:,.6g}" if number < 1e6 else f"{number:,.0f}")
            for key, number in traces.describe(trace).items()
        ]
        knots = ("knots", f"{len(trace.time_us)}")
        print(
            "\n" * (k > failed)
            + f"{printable(trace.name)}\n{columns([('source', trace.source), *trace.sheet.facts, knots, *lines])}"
        )
    return 2 if failed else 0


def validate(files: Files, /) -> int:
    """Read each file and say whether it is sound; exit code 1 if not all."""
    from bufgym import traces

    failed = 0
    for name in files:
        try:
            trace = traces.load(name)
        except TraceError as error:
            failed += 1
            print(f"error  {error}")
        else:
            about = traces.describe(trace)
            print(f"OK     {printable(trace.source)}: {about['duration_s']:.1f} s, mean {about['mean_KBps']:.1f} KB/s")
    if len(files) > 1:
        print(f"{len(files) - failed} of {len(files)} files are sound")
    return 1 if failed else 0


def convert(
    files: Files,
    /,
    *,
    out: Path,
    to: str | None = None,
    read: ReadOptions = ReadOptions(),
    columns: ColumnOptions = ColumnOptions(),
) -> None:
    """Write bandwidth traces in another format and name the loss.

    Args:
        out: The file to write; a folder for several files.
        to: csv or mahimahi; by default csv where --out ends in .csv.
    """
    from bufgym import traces

    to = to or ("csv" if out.suffix == ".csv" else None)
    if to not in traces.WRITERS:
        option = f"--to {to}" if to else f"--out {out}: does not tell the format; --to"
        raise BufgymError(f"{option}: must be one of {', '.join(traces.WRITERS)}")
    chosen = columns.chosen()
    for name, target in _targets(files, out, to):
        trace = read.load(name, chosen)
        traces.WRITERS[to](trace, target)
        lost = traces.difference(trace, traces.read_trace(target, to))
        print(printable(f"wrote {target} (format {to}) from {trace.source}: {lost}"))


def _targets(names: list[str], out: Path, to: str) -> list[tuple[str, Path]]:
    """Pair each file with its target: ``out`` for a single file, else a file of its name in the folder ``out``."""
    if len(names) == 1 and not out.is_dir():
        if out.exists() and Path(names[0]).exists() and out.samefile(names[0]):
            raise BufgymError(f"--out {out}: must not be the file that is read")
        return [(names[0], out)]
    from bufgym.traces.formats.links import trace_name

    if not out.is_dir():
        raise BufgymError(f"--out {out}: must be an existing folder for {len(names)} files")
    targets = [(name, out / (trace_name(name) + (".csv" if to == "csv" else ".mahimahi"))) for name in names]
    for name, target in targets:
        if [path for _, path in targets].count(target) > 1 or target.exists():
            raise BufgymError(f"{name}: {target} is taken: must be written by itself, with --out FILE")
    return targets


def plot(files: Files, /, *, out: Path) -> None:
    """Draw bandwidth traces (needs the extra 'plot').

    Args:
        out: The picture to write: .png, .svg or .pdf.
    """
    from bufgym import traces

    figures = library("matplotlib.figure", "plot", "drawing")
    if out.suffix not in _PICTURES:
        raise BufgymError(f"--out {out}: must end in {', '.join(_PICTURES[:-1])} or {_PICTURES[-1]}")
    loaded = [traces.load(name) for name in files]
    figure = figures.Figure(figsize=(9, 0.8 + 2 * len(loaded)), layout="constrained")
    axes = figure.subplots(len(loaded), 1, squeeze=False)[:, 0]
    for axis, trace in zip(axes, loaded, strict=True):
        _draw(axis, trace)
    axes[-1].set_xlabel("time (s)")
    figure.align_ylabels()
    figure.savefig(out, dpi=150)
    print(printable(f"wrote {out}"))


def _draw(axis: Axes, trace: Trace) -> None:
    """Draw rates over time; stretches under 500 KB/s are marked in red below zero."""
    import numpy as np

    from bufgym import traces

    lengths_us, rates = trace.samples()
    if len(rates) > _MOST_DRAWN:
        lengths_us, rates = trace.samples(-(-trace.duration_us // _MOST_DRAWN))
    edges_s = np.concatenate([[0], np.cumsum(lengths_us)]) / 1e6
    axis.stairs(rates / 1e6, edges_s, fill=True, color="tab:blue", alpha=0.35)
    axis.stairs(rates / 1e6, edges_s, color="tab:blue", linewidth=0.6)
    top = max(float(rates.max()) / 1e6, 0.001) * 1.05
    low = (rates < 500_000.0).astype(float)
    axis.stairs(-0.05 * top * low, edges_s, baseline=-0.02 * top * low, fill=True, color="tab:red", linewidth=0)
    summary = traces.describe(trace)
    title = f"mean {summary['mean_KBps'] / 1e3:.3g} MB/s, {summary['seconds_below_500KBps']:.4g} s under 500 KB/s (red)"
    axis.set_title(printable(trace.name), fontsize="medium", loc="left")
    axis.set_title(title, fontsize="small", loc="right")
    axis.set_ylabel("MB/s")
    axis.set_xlim(0, edges_s[-1])
    axis.set_ylim(-0.07 * top, top)

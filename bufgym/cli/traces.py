"""``bufgym trace``: bandwidth traces described and drawn."""

from __future__ import annotations

import argparse
from pathlib import Path

from bufgym.cli.options import Commands, columns, command
from bufgym.errors import BufgymError


def add(commands: Commands) -> None:
    trace = commands.add_parser("trace", help="look at bandwidth traces", description="Look at bandwidth traces.")
    verbs = trace.add_subparsers(title="verbs", metavar="VERB", required=True)
    info = command(verbs, "info", _info, "statistics of bandwidth traces")
    plot = command(verbs, "plot", _plot, "draw bandwidth traces (needs the extra 'plot')")
    for made in (info, plot):
        made.add_argument("files", nargs="+", metavar="FILE", help="a file or a shipped name")
    plot.add_argument("--out", required=True, metavar="FILE", help="the picture to write: .png, .svg or .pdf")


def _info(options: argparse.Namespace) -> None:
    from bufgym import traces

    blocks = []
    for name in options.files:
        trace = traces.load(name)
        lines = [
            (key, f"{number:,.6g}" if number < 1e6 else f"{number:,.0f}")
            for key, number in traces.describe(trace).items()
        ]
        knots = ("knots", f"{len(trace.time_us)}")
        blocks.append(f"{trace.name}\n" + columns([("source", trace.source), knots, *lines]))
    print("\n\n".join(blocks))


def _plot(options: argparse.Namespace) -> None:
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

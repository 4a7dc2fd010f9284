"""``bufgym trace fit``: link parameters from recordings."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from bufgym.cli.options import Commands, columns, command, count
from bufgym.ground.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.traces.trace import Float64Array


def add(commands: Commands) -> None:
    """Declare ``fit`` among the commands of ``bufgym trace``."""
    fit = command(commands, "fit", _fit, "fit the parameters of generated links to recordings")
    fit.add_argument("files", nargs="*", metavar="FILE", help="recordings; their names say the mode (report_car_2.csv)")
    fit.add_argument("--mode", metavar="NAME", help="all files are of this mode, whatever their names")
    help = "or the links that these suites train on; the mode is the suite's name without its version"
    fit.add_argument("--suite", type=lambda text: text.split(","), metavar="NAME,...", help=help)
    fit.add_argument("--data", metavar="DIR", help="the folder of recordings that the suites need")
    fit.add_argument("-o", "--out", required=True, metavar="FILE", help="the parameters to write (.json)")
    fit.add_argument("--page", metavar="FILE.md", help="also write a page that compares recordings and generated links")
    fit.add_argument(
        "--sets",
        type=count,
        default=199,
        metavar="N",
        help="generated sets for the page (%(default)s; the p-values are multiples of 1 / (N + 1))",
    )
    help = "recordings of each mode that the page holds out at most, a fit each (default: all)"
    fit.add_argument("--held-out", type=count, metavar="N", help=help)


def _fit(options: argparse.Namespace) -> None:
    from bufgym.traces.fit.fit import fit_links
    from bufgym.traces.fit.page import check_page, write_page
    from bufgym.traces.fit.statistics import LOW_BYTES_PER_S
    from bufgym.traces.generate.parameters import write_links

    if options.page is not None:
        check_page(Path(options.page))
    rows = _of_files(options) if options.suite is None else _of_suites(options)
    links = fit_links(rows)
    made_by = _command(options)
    write_links(links, options.out, LOW_BYTES_PER_S, made_by)
    print(columns([(mode, f"{link.recordings} recordings", f"{link.seconds} s") for mode, link in links.items()]))
    print(f"wrote {options.out}")
    if options.page is not None:
        page = Path(options.page)
        held_out = "" if options.held_out is None else f" --held-out {options.held_out}"
        command = f"{made_by} --page {page.name}{held_out}"
        write_page(links, rows, page, command, options.sets, options.held_out)
        print(f"wrote {options.page}")


def _of_files(options: argparse.Namespace) -> dict[str, list[Float64Array]]:
    """Collect rates by mode from the files that the options name."""
    from bufgym.traces.fit.fit import mode_of, rates_of

    if not options.files:
        raise BufgymError("trace fit: needs recordings, FILE ... or --suite NAME")
    if options.data is not None:
        raise BufgymError("--data: needs --suite")
    rows: dict[str, list[Float64Array]] = {}
    for file in sorted(set(options.files)):
        mode = options.mode or mode_of(file)
        rows.setdefault(mode, []).append(rates_of(file))
    return {mode: rows[mode] for mode in sorted(rows)}


def _of_suites(options: argparse.Namespace) -> dict[str, list[Float64Array]]:
    """Collect rates by mode from links in suites' training splits; validation and test stay unseen."""
    from bufgym.scenario import suites
    from bufgym.traces.trace import US_PER_S

    if options.files or options.mode:
        raise BufgymError("--suite: cannot go with FILE or --mode")
    rows = {}
    for name in options.suite:
        settings = suites.get(name).settings("train", options.data).values()
        traces = {trace.name: trace for setting in settings for trace in getattr(setting.scenario, "traces", ())}
        rows[name.rpartition("-v")[0]] = [trace.samples(US_PER_S)[1] for trace in traces.values()]
    return rows


def _command(options: argparse.Namespace) -> str:
    """Write the command to repeat it, with each folder's files as a pattern relative to their common folder."""
    if options.suite is not None:
        data = "" if options.data is None else " --data DIR"
        return f"bufgym trace fit --suite {','.join(options.suite)}{data} -o {Path(options.out).name}"
    folders = {(Path(file).resolve().parent, Path(file).suffix) for file in options.files}
    top = Path(os.path.commonpath([folder for folder, _ in folders]))
    top = top.parent if top in {folder for folder, _ in folders} else top
    patterns = {f"{folder.relative_to(top).as_posix()}/*{suffix}" for folder, suffix in folders}
    parts = ["bufgym trace fit", *sorted(patterns)]
    parts += [f"--mode {options.mode}"] if options.mode else []
    return " ".join([*parts, f"-o {Path(options.out).name}"])

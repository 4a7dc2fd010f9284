"""``bufgym trace fit``: link parameters from recordings."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from bufgym.cli.options import Commands, columns, command, count

if TYPE_CHECKING:
    from bufgym.traces.trace import Float64Array


def add(commands: Commands) -> None:
    """Declare ``fit`` among the commands of ``bufgym trace``."""
    fit = command(commands, "fit", _fit, "fit the parameters of generated links to recordings")
    fit.add_argument("files", nargs="+", metavar="FILE", help="recordings; their names say the mode (report_car_2.csv)")
    fit.add_argument("--mode", metavar="NAME", help="all files are of this mode, whatever their names")
    fit.add_argument("-o", "--out", required=True, metavar="FILE", help="the parameters to write (.json)")
    fit.add_argument("--page", metavar="FILE.md", help="also write a page that compares recordings and generated links")
    fit.add_argument(
        "--sets",
        type=count,
        default=199,
        metavar="N",
        help="generated sets for the page (%(default)s; the p-values are multiples of 1 / (N + 1))",
    )


def _fit(options: argparse.Namespace) -> None:
    from bufgym.traces.fit.fit import fit_links, mode_of, rates_of
    from bufgym.traces.fit.page import check_page, write_page
    from bufgym.traces.fit.statistics import LOW_BYTES_PER_S
    from bufgym.traces.generate.parameters import write_links

    if options.page is not None:
        check_page(Path(options.page))
    rows: dict[str, list[Float64Array]] = {}
    for file in sorted(set(options.files)):
        mode = options.mode or mode_of(file)
        rows.setdefault(mode, []).append(rates_of(file))
    rows = {mode: rows[mode] for mode in sorted(rows)}
    links = fit_links(rows)
    made_by = _command(options)
    write_links(links, options.out, LOW_BYTES_PER_S, made_by)
    print(columns([(mode, f"{link.recordings} recordings", f"{link.seconds} s") for mode, link in links.items()]))
    print(f"wrote {options.out}")
    if options.page is not None:
        page = Path(options.page)
        write_page(links, rows, page, f"{made_by} --page {page.name}", options.sets)
        print(f"wrote {options.page}")


def _command(options: argparse.Namespace) -> str:
    """The command to repeat it: each folder's files as a pattern, relative to the folder that all have in common."""
    folders = {(Path(file).resolve().parent, Path(file).suffix) for file in options.files}
    top = Path(os.path.commonpath([folder for folder, _ in folders]))
    top = top.parent if top in {folder for folder, _ in folders} else top
    patterns = {f"{folder.relative_to(top).as_posix()}/*{suffix}" for folder, suffix in folders}
    parts = ["bufgym trace fit", *sorted(patterns)]
    parts += [f"--mode {options.mode}"] if options.mode else []
    return " ".join([*parts, f"-o {Path(options.out).name}"])

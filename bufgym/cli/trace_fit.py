"""``bufgym trace fit``: link parameters from recordings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from bufgym.cli.options import Count, columns, command_line
from bufgym.ground.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.traces.trace import Float64Array


def fit(
    *files: str,
    mode: str | None = None,
    suite: str | None = None,
    data: str | None = None,
    out: Annotated[Path, Parameter(alias="-o")],
    page: Path | None = None,
    sets: Count = 199,
    held_out: Count | None = None,
) -> None:
    """Fit the parameters of generated links to recordings.

    Args:
        files: Recordings; their names say the mode (report_car_2.csv).
        mode: All files are of this mode, whatever their names.
        suite: Or the links that these suites (A,B) train on; the mode is the suite's name without its version.
        data: The folder of recordings that the suites need.
        out: The parameters to write (.json).
        page: Also write a page (.md) that compares recordings and generated links.
        sets: Generated sets for the page; the p-values are multiples of 1 / (N + 1).
        held_out: Recordings of each mode that the page holds out at most, a fit each (default: all).
    """
    from bufgym.traces.fit.fit import fit_links
    from bufgym.traces.fit.page import check_page, write_page
    from bufgym.traces.fit.statistics import LOW_BYTES_PER_S
    from bufgym.traces.generate.parameters import write_links

    if page is not None:
        check_page(page)
    if suite is None:
        if not files:
            raise BufgymError("trace fit: needs recordings, FILE ... or --suite NAME")
        if data is not None:
            raise BufgymError("--data: needs --suite")
        rows = _of_files(files, mode)
        made_by = command_line(" ".join(["trace fit", *_patterns(files)]), mode=mode) + f" -o {out.name}"
    else:
        if files or mode:
            raise BufgymError("--suite: cannot go with FILE or --mode")
        rows = _of_suites(suite.split(","), data)
        made_by = command_line("trace fit", suite=suite, data=data and "DIR") + f" -o {out.name}"
    links = fit_links(rows)
    write_links(links, out, LOW_BYTES_PER_S, made_by)
    print(columns([(mode, f"{link.recordings} recordings", f"{link.seconds} s") for mode, link in links.items()]))
    print(f"wrote {out}")
    if page is not None:
        made_by += f" --page {page.name}" + ("" if held_out is None else f" --held-out {held_out}")
        write_page(links, rows, page, made_by, sets, held_out)
        print(f"wrote {page}")


def _of_files(files: tuple[str, ...], mode: str | None) -> dict[str, list[Float64Array]]:
    """Collect rates by mode from the files."""
    from bufgym.traces.fit.fit import mode_of, rates_of

    rows: dict[str, list[Float64Array]] = {}
    for file in sorted(set(files)):
        rows.setdefault(mode or mode_of(file), []).append(rates_of(file))
    return {mode: rows[mode] for mode in sorted(rows)}


def _of_suites(names: list[str], data: str | None) -> dict[str, list[Float64Array]]:
    """Collect rates by mode from links in suites' training splits; validation and test stay unseen."""
    from bufgym.scenario import suites
    from bufgym.traces.trace import US_PER_S

    rows = {}
    for name in names:
        settings = suites.get(name).settings("train", data).values()
        traces = {trace.name: trace for setting in settings for trace in getattr(setting.scenario, "traces", ())}
        rows[name.rpartition("-v")[0]] = [trace.samples(US_PER_S)[1] for trace in traces.values()]
    return rows


def _patterns(files: tuple[str, ...]) -> list[str]:
    """Write each folder's files as a pattern relative to their common folder."""
    folders = {(Path(file).resolve().parent, Path(file).suffix) for file in files}
    top = Path(os.path.commonpath([folder for folder, _ in folders]))
    top = top.parent if top in {folder for folder, _ in folders} else top
    return sorted({f"{folder.relative_to(top).as_posix()}/*{suffix}" for folder, suffix in folders})

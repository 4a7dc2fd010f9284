"""``bufgym trace fit``: parameters of generated links, from recordings."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from bufgym.cli.options import columns
from bufgym.utils.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.traces.trace import Float64Array


def fit(
    *files: str,
    mode: str | None = None,
    suite: str | None = None,
    data: str | None = None,
    out: Annotated[Path | None, Parameter(alias="-o")] = None,
) -> None:
    """Fit the parameters of generated links to recordings.

    Args:
        files: Recordings; their names say the mode (report_car_2.csv).
        mode: All files are of this mode, whatever their names.
        suite: Or the links that these suites (A,B) train on; the mode is the suite's name without its version.
        data: The folder of recordings that the suites need.
        out: The parameters of links to write (.json).
    """
    if out is None:
        raise BufgymError("trace fit: needs --out FILE.json")
    from bufgym.traces.fit import LOW_BYTES_PER_S, fit_links
    from bufgym.traces.generate.parameters import write_links

    rows, words = recordings_of(files, mode, suite, data)
    links = fit_links(rows)
    write_links(links, out, LOW_BYTES_PER_S, f"bufgym trace fit {words} -o {out.name}")
    print(columns([(mode, f"{link.recordings} recordings", f"{link.seconds} s") for mode, link in links.items()]))
    print(f"wrote {out}")


def recordings_of(
    files: Sequence[str], mode: str | None, suite: str | None, data: str | None
) -> tuple[dict[str, list[Float64Array]], str]:
    """Collect the rates of recordings by mode; also return the words of a command line that ask for them."""
    from bufgym.traces import read_trace
    from bufgym.traces.fit import mode_of
    from bufgym.traces.trace import US_PER_S

    if suite is not None:
        if files or mode:
            raise BufgymError("--suite: cannot go with FILE or --mode")
        return _of_suites(suite.split(","), data), f"--suite {suite}" + (" --data DIR" if data else "")
    if not files:
        raise BufgymError("trace fit: needs recordings, FILE ... or --suite NAME")
    if data is not None:
        raise BufgymError("--data: needs --suite")
    rows: dict[str, list[Float64Array]] = {}
    for file in sorted(set(files)):
        rows.setdefault(mode or mode_of(file), []).append(read_trace(file).samples(US_PER_S)[1])
    words = [*_patterns(files), *(["--mode", mode] if mode else [])]
    return {mode: rows[mode] for mode in sorted(rows)}, " ".join(words)


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


def _patterns(files: Sequence[str]) -> list[str]:
    """Write each folder's files as a pattern relative to their common folder."""
    folders = {(Path(file).resolve().parent, Path(file).suffix) for file in files}
    top = Path(os.path.commonpath([folder for folder, _ in folders]))
    top = top.parent if top in {folder for folder, _ in folders} else top
    return sorted({f"{folder.relative_to(top).as_posix()}/*{suffix}" for folder, suffix in folders})

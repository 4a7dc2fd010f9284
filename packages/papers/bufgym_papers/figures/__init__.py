"""Reproductions of the figures, tables and theorems of the AFR and Robofleet papers.

``run("afr-fig5", Path("out"))`` returns a text with our numbers beside the paper's, and saves a CSV and a PNG under
``out``. Each figure is one module with a class ``Reproduction``, imported only when the figure is asked for. Most
numbers need bufgym alone. The figures on frames need the extra ``perception``. Keys in brackets, such as [wang2022afr],
refer to docs/references.bib.
"""

import importlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeAlias, cast

from bufgym.utils.errors import BufgymError, unknown
from bufgym_papers.figures.figure import Figure, report, save_picture, statements
from bufgym_papers.figures.rows import FigureRows

FIGURES: dict[str, str] = {name: texts["title"] for name, texts in statements().items() if "title" in texts}
"""Name of a figure -> its title."""

NEEDS_DATA: dict[str, str] = {name: texts["needs"] for name, texts in statements().items() if "needs" in texts}
"""Figure that needs recordings -> the files that its option ``data``, a folder, must hold."""

TAKES_DATA = (*NEEDS_DATA, *(name for name, texts in statements().items() if "data" in texts))
"""Figures with an option ``data``, whether they need it or only show more with it."""

STORE = "frame-runs"
"""Folder of finished runs on frames. Each run takes minutes; figures share them, and they survive a kill."""


def figure(name: str, out: Path | None = None, **options: Any) -> Figure:
    """Make the figure ``name`` with these options; a figure on frames keeps its finished runs in the folder ``out``."""
    kind = _kind(name)
    known = [option.name for option in fields(kind)]
    for option in options:
        if option not in known:
            raise unknown("option", option, known, place=name)
    if out is not None and "store" in known:
        options.setdefault("store", out / STORE)
    reproduction: Figure = kind(**options)
    return reproduction


def _kind(name: str) -> Any:
    if name not in FIGURES:
        raise unknown("figure", name, FIGURES)
    return importlib.import_module(f"{statements()[name]['package']}.{name.replace('-', '_')}").Reproduction


def run(name: str, out: Path | None = None, **options: Any) -> str:
    """Reproduce one figure; return a text that compares our numbers with the paper's.

    Args:
        name: a key of ``FIGURES``.
        out: folder for ``<name>.csv`` and ``<name>.png``, made if absent; None saves nothing.
        options: fields of that figure's ``Reproduction``, such as ``runs`` for afr-fig5.
    """
    reproduction = figure(name, out, **options)
    rows = reproduction.simulate()
    return "\n".join([*report(name, reproduction, rows), *_saved(reproduction, rows, out, name)])


def _saved(reproduction: Figure, rows: FigureRows, out: Path | None, stem: str) -> Iterator[str]:
    """Save the numbers and the picture in ``out``, unless it is None; yield lines that say where."""
    if out is None:
        return
    yield f"numbers: {rows.save(out / f'{stem}.csv')}"
    try:
        yield f"figure: {save_picture(reproduction, rows, out / f'{stem}.png')}"
    except BufgymError as error:  # the numbers are useful without the picture
        yield f"no figure: {error}"


Watch: TypeAlias = Callable[[int, float], AbstractContextManager[Callable[[], None]]]
"""Starts a progress display from the number of runs and their total time in s; gives a function to call per run."""


def run_live(name: str, out: Path | None = None, watch: Watch | None = None, **options: Any) -> str:
    """Run one figure both simulated and on real sockets, with the fewer and shorter runs of its ``LIVE`` options.

    ``watch`` shows the progress of the live runs. The rest is as for ``run``; options replace ``LIVE``'s.
    """
    from bufgym_papers.figures.on_sockets import apart  # sockets and threads, not needed to simulate

    if not hasattr(_kind(name), "LIVE"):
        raise BufgymError(f"{name}: is not played on sockets; robofleet-fig3 to robofleet-fig7 are")
    options = {**_kind(name).LIVE, **options}
    simulated, live = (cast(Any, figure(name, **{**options, "live": speed})) for speed in (0.0, options["live"]))
    lengths_s: list[float] = []
    simulated.watchers.append(lengths_s.append)
    played = [simulated.simulate()]
    runs, takes_s = len(lengths_s), sum(lengths_s) / live.live
    with nullcontext(lambda: None) if watch is None else watch(runs, takes_s) as step:
        live.watchers.append(lambda _: step())
        played.append(live.simulate())
    lines = [FIGURES[name], f"Options: {options}"]
    for medium, reproduction, rows in zip(("simulated", "live"), (simulated, live), played, strict=True):
        lines += ["", f"{medium.capitalize()}:", *reproduction.tables(rows)]
        lines += _saved(reproduction, rows, out, f"{name}-{medium}")
    return "\n".join([*lines, "", "Live, beside simulated:", *apart(*played)])

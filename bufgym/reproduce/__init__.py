"""The AFR and Robofleet papers' figures, tables and theorems again: our number beside the paper's.

``run("afr-fig5", Path("out"))`` returns a text to print and saves the numbers (CSV) and the picture (PNG) under
``out``. Each figure is one module with a class ``Reproduction``, imported only when it is asked for. The numbers need
nothing beyond bufgym (those of robofleet-table1 its extra ``robofleet``, those on frames ``perception`` and ``bench``);
the picture needs matplotlib, which comes with ``bufgym[plot]``. Keys in brackets, such as [wang2022afr], are those of
docs/references.bib.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeAlias, cast

from bufgym.errors import BufgymError
from bufgym.reproduce.figure import Figure, report, save_picture, statements
from bufgym.reproduce.rows import Rows

FIGURES: dict[str, str] = {name: texts["title"] for name, texts in statements().items() if "title" in texts}
"""Name -> what it shows, in one line."""

NEEDS_DATA: dict[str, str] = {name: texts["needs"] for name, texts in statements().items() if "needs" in texts}
"""Figures over recordings -> what the folder given as their option ``data`` must hold."""

TAKES_DATA = (*NEEDS_DATA, *(name for name, texts in statements().items() if "data" in texts))
"""Those, and the ones that show more with such a folder than without."""

STORE = "frame-runs.jsonl"
"""Runs on frames take minutes: those that are finished are kept here, for other figures and against a kill."""


def figure(name: str, **options: Any) -> Figure:
    """The figure ``name`` with these options.

    Raises:
        BufgymError: an unknown name or option, or an option's value that cannot be used.
    """
    kind = _kind(name)
    known = [option.name for option in fields(kind)]
    for option in options:
        if option not in known:
            raise BufgymError(f"{name}: no option {option!r}; it has: {', '.join(known)}")
    reproduction: Figure = kind(**options)
    return reproduction


def _kind(name: str) -> Any:
    if name not in FIGURES:
        raise BufgymError(f"unknown figure {name!r}; known: {', '.join(FIGURES)}")
    return importlib.import_module(f"bufgym.reproduce.{name.replace('-', '_')}").Reproduction


def kept_under(out: Path | None, name: str, **options: Any) -> Figure:
    """The figure ``name``; if it takes minutes, what is finished of it is kept in this folder."""
    made = figure(name, **options)
    if out is not None and getattr(made, "store", out) is None:
        return figure(name, **options, store=out / STORE)
    return made


def run(name: str, out: Path | None = None, **options: Any) -> str:
    """Reproduce one figure; the text compares our numbers with the paper's.

    Args:
        name: a key of ``FIGURES``.
        out: folder for ``<name>.csv`` and ``<name>.png``, made where absent; None saves nothing.
        options: fields of that figure's ``Reproduction``, such as ``runs`` for afr-fig5.
    """
    reproduction = kept_under(out, name, **options)
    rows = reproduction.simulate()
    lines = report(name, reproduction, rows)
    return "\n".join([*lines, *_saved(reproduction, rows, out, name)])


def _saved(reproduction: Figure, rows: Rows, out: Path | None, stem: str) -> Iterator[str]:
    """Save the numbers and the picture in the folder, if there is one; where they are."""
    if out is None:
        return
    yield f"numbers: {rows.save(out / f'{stem}.csv')}"
    try:
        yield f"figure: {save_picture(reproduction, rows, out / f'{stem}.png')}"
    except BufgymError as error:  # the numbers stand without it
        yield f"no figure: {error}"


Watch: TypeAlias = Callable[[int, float], AbstractContextManager[Callable[[], None]]]
"""Called with how many runs are to be played and how long that takes, s; gives what is called after each."""


def run_live(name: str, out: Path | None = None, watch: Watch | None = None, **options: Any) -> str:
    """One figure on real sockets and simulated, with the options of its ``LIVE``, which are fewer and shorter runs.

    Args:
        name: one of robofleet-fig3 to -fig7.
        out: folder for CSV and PNG of both; None saves nothing.
        watch: who waits is told how far the live runs are.
        options: as for ``run``, instead of those of ``LIVE``.
    """
    from bufgym.reproduce.on_sockets import apart  # sockets, threads: not for those who only simulate

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

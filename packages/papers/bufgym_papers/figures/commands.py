"""``bufgym reproduce``: reproductions of the papers' figures and tables."""

import itertools
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from bufgym.cli.options import columns
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.files import read_whole, write_text


def reproduce(
    *names: str,
    data: Path | None = None,
    claims: Path | None = None,
    live: bool = False,
    out: Path = Path("reproduced"),
) -> None:
    """Make figures and tables of the papers, our number beside theirs.

    Args:
        names: Which; 'all' for all; none lists them.
        data: Folder of recordings, for the figures that need one.
        claims: Run every figure and write the page of claims (Markdown) to this file; with names: renew the rows of
            these figures.
        live: robofleet-fig3 to -fig7 on real sockets too.
        out: Where pictures go.
    """
    from bufgym_papers import figures

    if live and claims is not None:
        raise BufgymError("--live: not with --claims, whose numbers are simulated")
    if data is not None and not data.is_dir():
        raise BufgymError(f"{data}: no such folder (--data)")
    if not names and claims is None:
        print("figures (bufgym reproduce NAME..., or all)\n" + columns(list(figures.FIGURES.items())))
        return
    for name in names:
        if name != "all" and name not in figures.FIGURES:
            raise unknown("figure", name, ["all", *figures.FIGURES])
    chosen = list(figures.FIGURES) if "all" in names else list(dict.fromkeys(names))
    if claims is not None:
        _claims(claims, chosen, out, data)
        return
    out.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(chosen):
        print(("\n" if k else "") + _text(name, out, data, named=name in names, live=live), flush=True)


def _claims(page: Path, names: list[str], out: Path, data: Path | None) -> None:
    """Write the page of claims, or renew the rows of these figures in it."""
    from bufgym_papers.figures.page import claims_page, renewed

    text = renewed(read_whole(page, 2**20).decode(), names, data, out) if names else claims_page(data, out)
    write_text(page, text)
    print(f"claims: {page}")


def _text(name: str, out: Path, data: Path | None, *, named: bool, live: bool) -> str:
    """Make the figure; if it was not named, leave it out where it can't be made, such as without a library."""
    from bufgym_papers import figures

    needs = figures.NEEDS_DATA.get(name)
    if needs is not None and data is None and not named:
        return f"{name}: left out; it needs a folder of recordings (--data DIR) with {needs}"
    try:
        if live:
            return figures.run_live(name, out, partial(_steps, name))
        return figures.run(name, out, **({"data": data} if name in figures.TAKES_DATA else {}))
    except BufgymError as error:
        if named:
            raise
        return f"{name}: left out: {error}"


@contextmanager
def _steps(name: str, runs: int, takes_s: float) -> Iterator[Callable[[], None]]:
    """Show the progress of live runs as a bar, or as lines without a terminal."""
    from bufgym.utils.progress import bar

    def note(text: str) -> None:
        print(f"{name}: {text}", file=sys.stderr, flush=True)

    note(f"{runs} runs on real sockets take about {takes_s:.0f} s")
    numbers = itertools.count(1)
    with bar(runs, show=True) as advance:

        def step() -> None:
            advance(1)
            if not sys.stderr.isatty():
                note(f"run {next(numbers)} of {runs}")

        yield step

"""``bufgym report``, ``leaderboard``, ``validate`` and ``curves``."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bufgym.cli.options import Whole
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError, printable

DEFAULT = "results/leaderboard.csv"


def report(folder: str, /, *, markdown: bool = False) -> None:
    """Make the page of a suite's run: one HTML file that works offline.

    Args:
        folder: Folder of bench --suite --out.
        markdown: Print tables for a README instead.
    """
    from bufgym.benchmark import report as pages

    text = pages.markdown(folder) if markdown else f"wrote {pages.write(folder)}"
    print("\n".join(map(printable, text.split("\n"))))


def leaderboard(
    suites: Annotated[list[str] | None, Parameter(name="--suite")] = None,
    *,
    file: Path = Path(DEFAULT),
    data: str | None = None,
    jobs: Whole | None = None,
) -> None:
    """Run suites and write the leaderboard, CSV and Markdown.

    Args:
        suites: Which, also module:NAME (default: all that need no recordings).
        file: The leaderboard.
        data: Folder of recordings, for suites over real links.
        jobs: Processes side by side (default: one a core).
    """
    from bufgym.benchmark import leaderboard as boards
    from bufgym.benchmark.tasks import task_of
    from bufgym.scenario.suites import SUITES, named

    names = [named(name) for name in suites or ()] or [
        name for name, suite in SUITES.items() if not suite.needs or data
    ]
    board = boards.make(file, {name: task_of(name).default_policies() for name in names}, data=data, jobs=jobs)
    print(f"{len(board)} rows in {file}, as Markdown in {file.with_suffix('.md')}")


def validate(row: str, /, *, file: Path = Path(DEFAULT), data: str | None = None, jobs: Whole | None = None) -> None:
    """Run one row of the leaderboard again and compare.

    Args:
        row: SUITE/POLICY; with a suite of your own module:NAME/POLICY.
        file: The leaderboard.
        data: Folder of recordings, for suites over real links.
        jobs: Processes side by side (default: one a core).
    """
    from bufgym.benchmark import leaderboard as boards
    from bufgym.scenario.suites import named

    if not file.exists():
        whose = f"{DEFAULT} is that of bufgym's repository" if file == Path(DEFAULT) else "as --file says"
        raise BufgymError(f"{file}: no such file ({whose}); bufgym leaderboard --file FILE.csv writes one")
    suite, _, policy = row.partition("/")
    if modules.is_named(suite):
        row = f"{named(suite)}/{policy}"
    entry = boards.find(file, row)
    again = boards.validate(entry, data=data, jobs=jobs)
    print(f"{entry.name}: holds")
    for key, (stated, low, high) in entry.values.items():
        print(f"  {key}: {again.values[key].value:.6f} now, {stated:.6f} [{low:.6f}, {high:.6f}] in {file}")


def curves(*runs: str, out: Path) -> None:
    """Draw learning curves over training seeds, with 95 % intervals.

    Args:
        runs: Folders of runs, such as runs/train-1, with a folder seed-N for each seed: of train.py, or with the
            0.monitor.csv that make_vec_env(monitor_dir=...) writes.
        out: The picture, .svg, .png or .pdf.
    """
    from bufgym.benchmark.curves import curves as draw

    for curve in draw(runs, out):
        reach = curve.reach[-1]
        within = "" if reach != reach else f" [{curve.mean[-1] - reach:.3f}, {curve.mean[-1] + reach:.3f}]"
        print(f"{curve.name}: {curve.measure} {curve.mean[-1]:.3f}{within} after {curve.steps[-1]:,.0f} steps")
    print(f"wrote {out}")

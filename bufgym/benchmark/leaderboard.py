"""The leaderboard: a row for each suite and policy, with the command that makes it again, and a check that it does."""

from __future__ import annotations

import csv
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from bufgym import __version__
from bufgym.benchmark import folder, sweep
from bufgym.benchmark.report import style, tables
from bufgym.benchmark.score import Interval, Standing, scores
from bufgym.errors import BufgymError, where
from bufgym.files import replaced
from bufgym.scenario import suites


@dataclass(frozen=True)
class Entry:
    """One row."""

    suite: str
    policy: str
    """As ``bufgym bench --policies`` takes it."""
    score: float
    score_low: float
    score_high: float
    regret: float
    regret_low: float
    regret_high: float
    better_than_afr: float
    cells: int
    """Those that bite: the others are not scored."""
    rank: int
    """0: not ranked."""
    bufgym: str
    """The version that made it."""
    command: str

    @property
    def name(self) -> str:
        """What ``bufgym validate`` calls it."""
        return f"{self.suite}/{self.policy}"


def command(suite: str, policy: str) -> str:
    """The command that makes one entry again."""
    needs = " --data DIR" if suites.get(suite).needs else ""
    return f"bufgym bench --suite {suite} --policies {policy}{needs}"


def entries(rows: Sequence[Mapping[str, Any]], suite: str, unranked: Mapping[str, str]) -> list[Entry]:
    """One entry for each policy of a suite's rows, best first."""
    made = []
    for rank, standing in enumerate(scores(rows, unranked=unranked).standings, 1):
        ranked = standing.ranked and not math.isnan(standing.score.value)
        made.append(_entry(standing, suite, rank if ranked else 0))
    return made


def _entry(standing: Standing, suite: str, rank: int) -> Entry:
    return Entry(
        suite,
        standing.policy,
        *standing.score,
        *standing.regret,
        standing.improvement.value,
        standing.cells,
        rank,
        __version__,
        command(suite, standing.policy),
    )


def make(path: Path, names: Sequence[str], specs: Mapping[str, Sequence[str]], **options: Any) -> list[Entry]:
    """Run the suites with their policies (``specs``, by suite) and write the file, whole or not at all."""
    made: list[Entry] = []
    for name in names:
        made += _run(name, specs[name], **options)
    write(made, path)
    return made


def _run(suite: str, specs: Sequence[str], data: str | None = None, jobs: int = -1) -> list[Entry]:
    plan = sweep.Plan(suite, tuple(specs), data=data)
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "run"
        rows = sweep.run_sweep(plan, out, jobs=jobs)
        return entries(rows, suite, folder.read_manifest(out / "manifest.json")["unranked"])


def validate(entry: Entry, **options: Any) -> Entry:
    """The entry made anew; an error if its score or its regret has left the interval that the file states."""
    (again,) = (e for e in _run(entry.suite, [entry.policy, "afr"], **options) if e.policy == entry.policy)
    for what in ("score", "regret"):
        low, stated, high = (getattr(entry, what + end) for end in ("_low", "", "_high"))
        found = getattr(again, what)
        inside = math.isnan(stated) if math.isnan(found) else low - 1e-9 <= found <= high + 1e-9
        if not inside:
            raise BufgymError(
                f"{entry.name}: {what} is {found:.6f}, outside [{low:.6f}, {high:.6f}] (stated: {stated:.6f})"
            )
    return again


# --- the file --------------------------------------------------------------------------------------------------------


def write(made: Sequence[Entry], path: Path) -> None:
    """A CSV file, and beside it the same as Markdown."""
    if path.suffix != ".csv":
        raise BufgymError(f"{path}: a leaderboard is written to a .csv file")
    with replaced(path) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(Entry)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(entry) for entry in made)
    with replaced(path.with_suffix(".md")) as temporary:
        temporary.write_text(markdown(made), encoding="utf-8")


def read(path: Path) -> dict[str, Entry]:
    """The entries by name; an error that names the file, the line and the value if one can't be read."""
    found: dict[str, Entry] = {}
    kinds: dict[str, Any] = {f.name: {"str": str, "int": int, "float": float}[str(f.type)] for f in fields(Entry)}
    with open(path, encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        if reader.fieldnames != list(kinds):
            raise BufgymError(where(path, 1, None, f"must have the columns {', '.join(kinds)}"))
        for line in reader:
            values = {}
            for name, kind in kinds.items():
                try:
                    values[name] = kind(line[name])
                except (TypeError, ValueError):
                    raise BufgymError(
                        where(path, reader.line_num, line[name], "must be a number", field=name)
                    ) from None
            entry = Entry(**values)
            found[entry.name] = entry
    return found


def find(path: Path, name: str) -> Entry:
    """The entry of that name."""
    held = read(path)
    if name not in held:
        raise BufgymError(f"{path}: no row {name!r}; rows are named suite/policy, such as {next(iter(held), 'none')}")
    return held[name]


def markdown(made: Sequence[Entry]) -> str:
    """A table a suite."""
    head = ["#", "policy", "score", "regret", "better than afr", "command"]
    out = [
        "# Leaderboard",
        "",
        "Score: 0 is Drop Oldest (what ROS does), 1 the clairvoyant, which no policy can pass; regret: what was lost",
        "against the clairvoyant. 95 % bootstrap intervals over test episodes. `bufgym leaderboard` makes the file,",
        "`bufgym validate SUITE/POLICY` checks a row.",
    ]
    for suite in dict.fromkeys(entry.suite for entry in made):
        lines = []
        for entry in made:
            if entry.suite == suite:
                score = " ".join(tables.pair(Interval(entry.score, entry.score_low, entry.score_high), style.score))
                lost = Interval(entry.regret, entry.regret_low, entry.regret_high)
                regret = " ".join(tables.pair(lost, style.percent))
                better = style.score(entry.better_than_afr)
                rank = str(entry.rank) if entry.rank else "–"
                lines.append([rank, entry.policy, score, regret, better, f"`{entry.command}`"])
        out += ["", f"## {suite}", "", f"{suites.get(suite).about}.", "", *tables.markdown_table(head, lines, left=2)]
    return "\n".join(out) + "\n"

"""``bufgym.compare`` and ``bufgym.make_policy``: policies side by side on the same episodes."""

import html
import math
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from bufgym import scenario as registered
from bufgym.benchmark import folder, report, sources, table, tasks
from bufgym.benchmark import sweep as sweeps
from bufgym.benchmark.estimates import ESTIMATE, estimates
from bufgym.benchmark.own_suite import suite_named
from bufgym.benchmark.parts import run_parts
from bufgym.benchmark.report import tables
from bufgym.benchmark.rows import Layout, Row, write_rows
from bufgym.benchmark.sources import PolicyLike as PolicyLike
from bufgym.benchmark.sources import make_policy as make_policy
from bufgym.benchmark.sweep import Sweep
from bufgym.policies import Policy
from bufgym.scenario import suites
from bufgym.scenario.registry import parameters
from bufgym.scenario.texts import doubts
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.files import write_text
from bufgym.utils.libraries import library
from bufgym.utils.modules import is_named

KEYWORDS = ("capacity", "seeds", "progress", "about", "label", "against", "out", "form")
OF_A_QUEUE = ("max_bytes", "decide_at", "bound")
OF_PROCESSES = ("jobs", "backend", "address", "policy_file")
OF_A_SUITE = ("split", "data", "changes", "command", *OF_PROCESSES)


@dataclass(frozen=True, repr=False)
class Comparison:
    """Policies side by side on the same episodes. It prints as its table, in a notebook too."""

    rows: list[Row]
    """One row for each policy, capacity and episode; with several topics or robots, one for each of these."""
    about: str
    """The scenario or suite."""
    unranked: Mapping[str, str]
    """The policies that do not compete, with the reasons."""
    layout: Layout  # the columns of ``rows``
    page: Callable[[str], str]  # the page, for the command that it names
    forms: Mapping[str, str]  # the table by form
    estimates: list[dict[str, Any]]
    """Each quantity of each policy, over "all" and by scenario and capacity: ``estimate``, ``low`` and ``high``."""

    @property
    def plain(self) -> str:
        """The table as aligned text."""
        return self.forms["plain"]

    def table(self, form: str = "plain") -> str:
        """Means by policy: ``"plain"`` text, ``"markdown"``, or ``"latex"`` (for the package booktabs)."""
        if form not in (known := ("plain", "markdown", "latex")):
            raise BufgymError(f"form = {form!r}: must be one of {', '.join(map(repr, known))}")
        return self.forms[form]

    def to_pandas(self, what: str = "rows") -> Any:
        """``"rows"`` or ``"estimates"`` as a pandas DataFrame.

        ``scenario`` in rows is the name, or ``about`` where it has none.
        """
        try:
            import pandas  # type: ignore[import-untyped,unused-ignore]
        except ImportError:
            raise BufgymError("to_pandas needs pandas: pip install pandas") from None
        if what not in ("rows", "estimates"):
            raise BufgymError(f"what = {what!r}: must be 'rows' or 'estimates'")
        if what == "estimates":
            return pandas.DataFrame(self.estimates)
        about = self.about.partition("\n")[0]
        return pandas.DataFrame([{**row, "scenario": row["scenario"] or about} for row in self.rows])

    def plot(self, axes: Any = None) -> Any:
        """Draw each policy's regret as a bar, a colour for each L; Matplotlib's axes. QoI where no regret is known."""
        pyplot = library("matplotlib.pyplot", "plot", "plot")
        axes = pyplot.subplots(layout="constrained")[1] if axes is None else axes
        entries = table.means(self.rows, self.unranked)
        capacities = list(dict.fromkeys(entry["capacity"] for entry in entries))
        names = list(dict.fromkeys(entry["policy"] for entry in reversed(entries)))
        height = 0.8 / len(capacities)
        key, scale, label = "regret", 100, "regret: part of the best QoI that is lost, % (shorter is better)"
        if any(math.isnan(entry["regret"]) for entry in entries):
            key, scale, label = "qoi", 1, "QoI, mean over the episodes (longer is better)"
        for k, capacity in enumerate(capacities):
            bars = [entry for entry in entries if entry["capacity"] == capacity]
            lanes = [names.index(entry["policy"]) + (k - (len(capacities) - 1) / 2) * height for entry in bars]
            axes.barh(lanes, [scale * entry[key] for entry in bars], height, label=f"L = {capacity}")
        axes.set_yticks(range(len(names)), names)
        axes.set_xlabel(label)
        axes.set_title(self.about.partition("\n")[0], fontsize="medium", loc="left")
        if len(capacities) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
        return axes

    def report(self, path: str | Path, command: str = "bufgym.compare(...)") -> Path:
        """Write the page of ``bufgym report`` to this file (extra ``report``); return its path."""
        return write_text(Path(path), self.page(command))

    def write_rows(self, path: str | Path) -> Path:
        """Write the rows to this ``.csv`` or ``.parquet`` file; return its path."""
        return write_rows(self.rows, path, self.layout)

    def write_estimates(self, path: str | Path) -> Path:
        """Write the estimates to this ``.csv`` or ``.parquet`` file; return its path."""
        return write_rows(self.estimates, path, ESTIMATE)

    def write_table(self, path: Path) -> Path:
        """Write ``about`` and the table as Markdown to this file; return its path."""
        return write_text(path, f"{self.about}\n\n{self.forms['markdown']}\n")

    def __str__(self) -> str:
        return f"{self.about}\n\n{self.plain}"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(self.about)}</p>\n{self.forms['html']}"


def compare(
    policies: PolicyLike | Sequence[PolicyLike],
    on: Any = "lte",
    *,
    capacity: int | Sequence[int] | None = None,
    seeds: int | Sequence[int] | None = None,
    progress: bool = True,
    about: str = "",
    label: str = "",
    against: PolicyLike | None = None,
    out: str | Path | None = None,
    form: str | None = None,
    **settings: Any,
) -> Comparison:
    """Run each policy on the same episodes of a scenario or a suite.

    Args:
        policies: as ``make_policy`` takes them.
        on: a scenario, its name (see ``bufgym list``), also with parameters as in ``"lte:rate_hz=5"``, a client's
            .toml file, or a suite's name such as ``"outage-v1"``.
        capacity: L, messages, or several; by default 8, with topics 32, or the suite's.
        seeds: so many episodes on each trace, or these; by default 10, with topics 5, or the suite's.
        progress: show a bar on stderr, where that is a terminal.
        about: lines that stand above the table and explain it; by default what ``on`` is.
        label: the scenario's name in the rows; by default the name that ``on`` gives.
        against: a policy that every other is compared with, by the paired difference of their shares of AFR's regret
            (of QoI over Robofleet's with topics, of the gain over AFR with a fleet). It and AFR run too.
        out: a folder that keeps the rows and the table; a suite's run in it is resumed, any other begins an empty one.
        form: format of the rows in ``out``, "parquet" or "csv"; by default parquet if pyarrow is installed.
        settings: of processes, ``jobs`` (side by side, -1 for one a core; by default one, a suite's one a core),
            ``backend``, ``address`` and ``policy_file``, as of ``run_sweep``. Of a queue, ``max_bytes``, ``decide_at``
            and ``bound`` (False leaves out the clairvoyant and all that is measured against it). Of a suite, settings
            of ``Sweep`` and ``run_sweep``: ``split``, ``data``, ``changes`` and ``command``. The others are parameters
            of a scenario that is named.

    Raises:
        BufgymError: an argument is out of its range, or there is no such policy, scenario or suite.
    """
    several = [policies] if isinstance(policies, str | Path | Policy) or callable(policies) else policies
    entrants = [make_policy(policy) for policy in several]
    rival = None if against is None else make_policy(against)
    if not entrants:
        raise BufgymError("policies = []: need at least one")
    capacities = (capacity,) if isinstance(capacity, int) else tuple(capacity or ())
    on = os.fspath(on) if isinstance(on, os.PathLike) else on
    frozen = suite_named(on)
    if frozen:
        return _compare_on_suite(
            entrants, frozen, rival, capacities, seeds, out=out, form=form, progress=progress, **settings
        )
    of_a_queue = {name: settings.pop(name) for name in OF_A_QUEUE if name in settings}
    processes = {name: settings.pop(name) for name in OF_PROCESSES if name in settings}
    label, scenario = label or (on if isinstance(on, str) else ""), _scenario(on, settings)
    about = "\n".join([about or label or registered.about(scenario), *doubts(scenario)])
    words: dict[str, Any] = {"label": label, "about": about, "processes": processes}
    play = partial(_compare_on_scenario, entrants, scenario, rival, capacities, seeds, progress=progress)
    if out is None:
        return play(**words, **of_a_queue)
    place = Path(out)
    folder.check_free(place)
    with folder.made(place):
        comparison = play(**words, **of_a_queue)
        comparison.write_rows(place / f"rows.{form or folder.form_of_rows(place)}")
        comparison.write_table(place / "table.md")
    return comparison


def _scenario(on: Any, settings: dict[str, Any]) -> Any:
    """The scenario that ``on`` is or names; ``settings`` are parameters of one that is named."""
    named = isinstance(on, str)
    if named and not (on.partition(":")[0] in registered.SCENARIOS or on.endswith(".toml") or is_named(on)):
        raise unknown("scenario or suite", on, [*registered.SCENARIOS, *suites.SUITES])
    scenario = registered.get(on) if named else on
    known = parameters(scenario) if named else []
    for name in settings:
        if name not in known:
            raise unknown("keyword", name, [*KEYWORDS, *OF_A_QUEUE, *OF_A_SUITE, *known], place="compare")
    return registered.get(scenario, **settings) if settings else scenario


def _compare_on_scenario(
    entrants: Sequence[Policy],
    scenario: Any,
    rival: Policy | None,
    capacities: Sequence[int],
    seeds: int | Sequence[int] | None,
    *,
    label: str,
    about: str,
    progress: bool,
    processes: dict[str, Any],
    **of_a_queue: Any,
) -> Comparison:
    """Run the policies, summarise their rows, and render the summary."""
    task = tasks.task_for(scenario, **of_a_queue)
    invited = _with_rival(entrants, rival, task)
    players = _with_missing(invited, [make_policy(task.baseline)])
    seeds = task.seeds if seeds is None else seeds
    processes["jobs"] = _jobs(players, processes.get("jobs"), processes.get("policy_file"))
    how: dict[str, Any] = {"label": label, "progress": progress, **processes, **of_a_queue}
    played = run_parts(players, scenario, capacities or (task.capacity,), seeds, **how)
    holes = [hole for trace in getattr(scenario, "traces", ()) for hole in trace.holes]
    if holes and task.kind == "queue":
        zero = not any(trace.rate_bytes_per_s([start for start, _ in trace.holes]).any() for trace in scenario.traces)
        used, other = ("zero", "hold") if zero else ("hold", "zero")
        filled = replace(scenario, traces=tuple(trace.with_holes(other) for trace in scenario.traces))
        again = run_parts(players, filled, capacities or (task.capacity,), seeds, **how)
        others = {(entry["policy"], entry["capacity"]): entry["qoi"] for entry in table.means(again)}
        both = ", ".join(
            f"{entry['policy']} {entry['qoi']:.3f} or {others[entry['policy'], entry['capacity']]:.3f}"
            for entry in table.means(played)
        )
        about += f"\nQoI with --holes {used} (as below) or {other}: {both}"

    unranked = table.unranked_among(players)
    summary = task.summary(played, unranked, "" if rival is None else rival.name)

    hidden = "" if task.shows_baseline or players == invited else task.baseline
    rendered = [part.forms() for part in task.tables(played, summary, scenario, unranked, hidden)]
    forms = {name: "\n\n".join(part[name] for part in rendered) for name in rendered[0]}
    page = partial(report.page_of_rows, task, played, players, unranked, scenario, about)
    rows = [row for row in played if row["policy"] != hidden]
    return Comparison(rows, about, unranked, task.layout, page, forms, estimates(summary))


def _compare_on_suite(
    entrants: Sequence[Policy],
    suite: str,
    rival: Policy | None,
    capacities: tuple[int, ...],
    seeds: int | Sequence[int] | None,
    *,
    out: str | Path | None,
    **how: Any,
) -> Comparison:
    """Run the policies in the suite's processes, read the summary of the run's folder, and render it."""
    if frozen := [name for name in how if name not in (*OF_A_SUITE, "form", "progress")]:
        raise BufgymError(f"{', '.join(frozen)}: a suite's episodes are frozen")
    if seeds is not None and not isinstance(seeds, int):
        raise BufgymError(f"seeds = {seeds!r}: on a suite, must be how many")
    players = _with_rival(entrants, rival, tasks.task_of(suite))
    of_the_sweep = {field.name: how.pop(field.name) for field in fields(Sweep) if field.name in how}
    sweep = Sweep(suite, tuple(players), capacities=capacities, seeds=seeds, **of_the_sweep)
    how["jobs"] = _jobs(players, how.get("jobs"), sweep.policy_file)
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(out or Path(scratch, "run"))
        rows = sweeps.run_sweep(sweep, place, **how)
        finished, summary = report.run_of(place, "" if rival is None else rival.name)
    forms = {"plain": tables.plain(finished, summary), "markdown": tables.markdown(finished, summary)}
    forms |= {"html": tables.html(summary), "latex": tables.latex(summary)}
    unranked, page = table.unranked_among(players), partial(report.page_of_run, finished)
    return Comparison(rows, f"suite {suite}", unranked, sweep.task.layout, page, forms, estimates(summary))


def _jobs(players: Sequence[Policy], asked: int | None, policy_file: str | None) -> int | None:
    """How many processes: one where others can't know what this one's own code made, in a script or a notebook."""
    alone = [policy.name for policy in players if not sources.known_elsewhere(policy)]
    if not alone or policy_file is not None:
        return asked
    if asked not in (None, 1):
        rule = "known to this process alone: jobs = 1, or name it as module:function or by its file"
        raise BufgymError(f"policy {alone[0]}: {rule}")
    return 1


def _with_rival(entrants: Sequence[Policy], rival: Policy | None, task: tasks.Task) -> list[Policy]:
    """The entrants, then the policies that a comparison with ``rival`` needs."""
    return _with_missing(entrants, [] if rival is None else [rival, make_policy(task.reference)])


def _with_missing(entrants: Sequence[Policy], needed: Sequence[Policy]) -> list[Policy]:
    """The entrants, then those of ``needed`` that are not among them by name."""
    present = {policy.name for policy in entrants}
    missing = {policy.name: policy for policy in needed if policy.name not in present}
    return [*entrants, *missing.values()]

"""``bufgym.compare`` and ``bufgym.make_policy``: policies side by side on the same episodes."""

from __future__ import annotations

import html
import math
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

from bufgym import policies, scenario
from bufgym.benchmark import report, sources, table, tasks
from bufgym.benchmark import sweep as sweeps
from bufgym.benchmark.report import tables
from bufgym.benchmark.rows import Row
from bufgym.benchmark.run import run
from bufgym.benchmark.sources import PolicyLike as PolicyLike
from bufgym.benchmark.sources import make_policy as make_policy
from bufgym.benchmark.sweep import Sweep
from bufgym.ground.errors import BufgymError, unknown
from bufgym.ground.libraries import library
from bufgym.ground.modules import is_named
from bufgym.policies import Policy
from bufgym.scenario import suites
from bufgym.scenario.registry import parameters

KEYWORDS = ("capacity", "seeds", "progress", "about", "against")
QUEUE = ("max_bytes", "decide_at", "bound")  # Settings of a queue


@dataclass(frozen=True, repr=False)
class Comparison:
    """Policies side by side on the same episodes. It prints as its table, in a notebook too."""

    rows: list[Row]
    """One row for each policy, capacity and episode; with several topics or robots, one for each of these."""
    about: str
    """The scenario or suite."""
    unranked: Mapping[str, str]
    """The policies that do not compete, with the reasons."""
    page: Callable[[str], str]  # the page, for the command that it names
    plain: str  # the table as aligned text
    markdown: str
    html: str

    def table(self, form: str = "plain") -> str:
        """Means by policy: ``"plain"`` text or ``"markdown"``."""
        if form not in ("plain", "markdown"):
            raise BufgymError(f"form = {form!r}: must be 'plain' or 'markdown'")
        return self.plain if form == "plain" else self.markdown

    def to_pandas(self) -> Any:
        """``rows`` as a pandas DataFrame; ``scenario`` is the name, or ``about`` where it has none."""
        try:
            import pandas  # type: ignore[import-untyped,unused-ignore]
        except ImportError:
            raise BufgymError("to_pandas needs pandas: pip install pandas") from None
        about = self.about.partition("\n")[0]
        return pandas.DataFrame([{**row, "scenario": row["scenario"] or about} for row in self.rows])

    def plot(self, axes: Any = None) -> Any:
        """Draw each policy's regret as a bar, a colour for each L; Matplotlib's axes. QoI where no regret is known."""
        pyplot = library("matplotlib.pyplot", "plot", "plot")
        axes = pyplot.subplots(layout="constrained")[1] if axes is None else axes
        entries = table.means(self.rows, alone=self.unranked)
        capacities = list(dict.fromkeys(entry["capacity"] for entry in entries))
        names = list(dict.fromkeys(entry["policy"] for entry in reversed(entries)))
        height = 0.8 / len(capacities)
        key, scale, label = "regret", 100, "regret: part of the best QoI that is lost, % (shorter is better)"
        if any(math.isnan(entry["regret"]) for entry in entries):
            key, scale, label = "qoi", 1, "QoI, mean over the episodes (longer is better)"
        for k, capacity in enumerate(capacities):
            chosen = [entry for entry in entries if entry["capacity"] == capacity]
            places = [names.index(entry["policy"]) + (k - (len(capacities) - 1) / 2) * height for entry in chosen]
            axes.barh(places, [scale * entry[key] for entry in chosen], height, label=f"L = {capacity}")
        axes.set_yticks(range(len(names)), names)
        axes.set_xlabel(label)
        axes.set_title(self.about.partition("\n")[0], fontsize="medium", loc="left")
        if len(capacities) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
        return axes

    def report(self, path: str | Path, command: str = "bufgym.compare(...)") -> Path:
        """Write the page of ``bufgym report`` to this file (extra ``report``); return its path."""
        return report.save(self.page(command), Path(path))

    def __str__(self) -> str:
        return f"{self.about}\n\n{self.plain}"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(self.about)}</p>\n{self.html}"


def compare(
    policies: PolicyLike | Sequence[PolicyLike],
    on: Any = "lte",
    *,
    capacity: int | Sequence[int] | None = None,
    seeds: int | Sequence[int] | None = None,
    progress: bool = True,
    about: str = "",
    against: PolicyLike | None = None,
    **settings: Any,
) -> Comparison:
    """Run each policy on the same episodes of a scenario or a suite.

    Args:
        policies: as ``make_policy`` takes them.
        on: a scenario, its name (see ``bufgym list``), also with parameters as in ``"lte:rate_hz=5"``, a client's
            .toml file, or a suite's name such as ``"outage-v1"``.
        capacity: L, messages, or several; by default 8, or the suite's.
        seeds: so many episodes on each trace, or these; by default 10, or the suite's.
        progress: show a bar on stderr, where that is a terminal.
        about: lines that stand above the table and explain it; by default what ``on`` is.
        against: a policy that every other is compared with, by the paired difference of their shares of AFR's regret
            (of QoI over Robofleet's with topics, of the gain over AFR with a fleet). It and AFR run too.
        settings: of a queue, ``max_bytes``, ``decide_at`` and ``bound`` (False leaves out the clairvoyant and all that
            is measured against it); the others are parameters of a scenario that is named.

    Raises:
        BufgymError: an argument is out of its range, or there is no such policy, scenario or suite.
    """
    several = [policies] if isinstance(policies, str | Path | Policy) or callable(policies) else policies
    chosen = [make_policy(policy) for policy in several]
    rival = None if against is None else make_policy(against)
    capacities = [capacity] if isinstance(capacity, int) else list(capacity or ())
    on = os.fspath(on) if isinstance(on, os.PathLike) else on
    if isinstance(on, str) and on in suites.SUITES:
        if settings:
            raise BufgymError(f"{', '.join(settings)}: a suite's episodes are frozen")
        if seeds is not None and not isinstance(seeds, int):
            raise BufgymError(f"seeds = {seeds!r}: on a suite, must be how many")
        return on_suite(chosen, on, rival, capacities=tuple(capacities), seeds=seeds, form="csv", progress=progress)
    if isinstance(on, str) and not (on.partition(":")[0] in scenario.SCENARIOS or on.endswith(".toml") or is_named(on)):
        raise unknown("scenario or suite", on, [*scenario.SCENARIOS, *suites.SUITES])
    queue = {name: settings.pop(name) for name in QUEUE if name in settings}
    stream = scenario.get(on) if isinstance(on, str) else on
    known = parameters(stream) if isinstance(on, str) else []
    for name in settings:
        if name not in known:
            raise unknown("keyword", name, [*KEYWORDS, *QUEUE, *known], place="compare")
    stream = scenario.get(stream, **settings) if settings else stream
    label, seeds, capacities = on if isinstance(on, str) else "", 10 if seeds is None else seeds, capacities or [8]
    return beside(chosen, stream, capacities, seeds, label=label, about=about, rival=rival, progress=progress, **queue)


def beside(
    chosen: Sequence[Policy],
    stream: Any,
    capacities: Sequence[int],
    seeds: int | Sequence[int],
    *,
    label: str = "",
    about: str = "",
    rival: Policy | None = None,
    progress: bool = True,
    **queue: Any,
) -> Comparison:
    """``compare`` for policies and a scenario that are at hand; ``label`` is the scenario's name in the rows."""
    task = tasks.of(stream)
    chosen = _with(chosen, rival, task)
    added = all(policy.name != task.baseline for policy in chosen)
    chosen = [*chosen, make_policy(task.baseline)] if added and chosen else chosen
    played = run(chosen, stream, capacities, seeds, label=label, progress=progress, **queue)
    unranked, heading = table.apart(chosen), about or label or scenario.about(stream)
    found = task.summary(played, unranked, "" if rival is None else rival.name)
    hidden = task.baseline if added and not task.shows_baseline else ""
    rows, floor = ([row for row in played if (row["policy"] == hidden) == there] for there in (False, True))
    shown = task.tables(rows, floor, found, unranked, {label: scenario.about(stream)})
    forms = ["\n\n".join(texts) for texts in zip(*(part.forms() for part in shown), strict=True)]
    page = partial(report.page_of, played, () if queue else chosen, unranked, stream, heading)
    return Comparison(rows, heading, unranked, page, *forms)


def _with(chosen: Sequence[Policy], rival: Policy | None, task: tasks.Task) -> list[Policy]:
    """The policies, then the ones that a comparison with ``rival`` needs."""
    more = [] if rival is None else [rival, make_policy(task.reference)]
    known = {policy.name for policy in chosen}
    return [*chosen, *({policy.name: policy for policy in more if policy.name not in known}.values())]


def on_suite(
    chosen: Sequence[Policy], suite: str, rival: Policy | None = None, folder: Path | None = None, **how: Any
) -> Comparison:
    """``compare`` for policies that are at hand and a suite, whose processes know them by name.

    ``folder`` keeps the run. ``how`` has further settings of the ``Sweep``, and arguments of ``run_sweep``.
    """
    chosen = _with(chosen, rival, tasks.TASKS[suites.get(suite).kind])
    registered = {*policies.names(), *policies.names(named_only=True)}
    for policy in chosen:
        base = policy.name.partition(":")[0]
        if base not in registered or policies.get(base).on_arrival is not policy.on_arrival:
            raise BufgymError(
                f"policy {policy.name}: register it to run it on a suite, whose processes know it by name"
            )
    settings = {field.name: how.pop(field.name) for field in fields(Sweep) if field.name in how}
    sweep = Sweep(suites.get(suite).name, tuple(policy.name for policy in chosen), **settings)
    # Other processes can't know what a user's own code registered in this one.
    if sweep.policy_file is None and not all(policy.built_in or sources.made([policy.name]) for policy in chosen):
        how["jobs"] = 1
    with tempfile.TemporaryDirectory() as scratch:
        folder = folder or Path(scratch) / "run"
        rows = sweeps.run_sweep(sweep, folder, **how)
        made, found = report.run_of(folder, "" if rival is None else rival.name)
    shown = tables.plain(made, found), tables.markdown(made, found), tables.html(found)
    return Comparison(rows, f"suite {sweep.suite}", table.apart(chosen), partial(report.page_for, made), *shown)

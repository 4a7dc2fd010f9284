"""``bufgym.compare`` and ``bufgym.make_policy``: policies side by side on the same episodes."""

from __future__ import annotations

import html
import math
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from bufgym import policies, scenario
from bufgym.benchmark import bootstrap, report, sources, summary, table, tasks
from bufgym.benchmark.report import tables
from bufgym.benchmark.rows import Row
from bufgym.benchmark.run import run
from bufgym.benchmark.sweep import Sweep, run_sweep
from bufgym.ground.errors import BufgymError, unknown
from bufgym.ground.libraries import library
from bufgym.ground.modules import is_named
from bufgym.oracle.measure import BASELINE
from bufgym.policies import Policy
from bufgym.policies.registry import OnArrival
from bufgym.scenario import suites
from bufgym.scenario.registry import parameters

KEYWORDS = ("capacity", "seeds", "progress", "about", "against")
QUEUE = ("max_bytes", "decide_at", "bound")  # Settings of a queue
PolicyLike = Policy | str | Path | OnArrival


def make_policy(spec: PolicyLike) -> Policy:
    """A policy from its name, a function, or a file.

    Args:
        spec: a registered name (``"afr"``, ``"decimate:every=2"``), a function (buffer, arrival, memory),
            ``"module:function"``, a model of stable-baselines3 (``.zip``, which can run any code), or a learned policy
            (``.safetensors``, which runs none). A ``Policy`` comes back as it is.

    Raises:
        BufgymError: there is no such policy, or the file holds none.
    """
    if isinstance(spec, Path) or (isinstance(spec, str) and sources.is_source(spec)):
        spec = sources.load(os.fspath(spec))
    return policies.get(spec)


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
    named = "" if rival is None else rival.name
    words = (*several, against)
    files = [os.fspath(p) for p in words if isinstance(p, Path) or (isinstance(p, str) and sources.is_source(p))]
    capacities = [capacity] if isinstance(capacity, int) else list(capacity or ())
    on = os.fspath(on) if isinstance(on, os.PathLike) else on
    if isinstance(on, str) and on in suites.SUITES:
        if settings:
            raise BufgymError(f"{', '.join(settings)}: a suite's episodes are frozen")
        chosen = _with(chosen, rival, tasks.TASKS[suites.get(on).kind])
        return _on_suite(chosen, files, on, capacities, seeds, progress, named)
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
    alone = all(policy.name != task.baseline for policy in chosen)
    chosen = [*chosen, make_policy(task.baseline)] if alone and chosen else chosen
    unranked, named = table.apart(chosen), "" if rival is None else rival.name
    played = run(chosen, stream, capacities, seeds, label=label, progress=progress, **queue)
    heading = about or label or scenario.about(stream)
    page = partial(report.page_of, played, () if queue else chosen, unranked, stream, heading)
    if task.kind != "queue":
        found = task.summary(played, unranked, named)
        shown = summary.table_of(found, {label: scenario.about(stream)}, ["", *task.notes(played, found)])
        return Comparison(played, heading, unranked, page, *shown.forms())
    rows = [row for row in played if not (alone and row["policy"] == BASELINE)]
    floor = [row for row in played if alone and row["policy"] == BASELINE]
    found = task.summary(played, unranked, named)
    cells = [cell for cell in found.scores.cells if cell.episodes > 1] if found.scores else []
    behind = {(cell.capacity, cell.policy): bootstrap.written(cell.score, table.score)[1] for cell in cells}
    shown = table.of(rows, floor, unranked, behind)
    if "score" in shown.head:
        shown = shown._replace(notes=[table.SCORE, *[table.BRACKETS] * any(behind.values()), *shown.notes])
    texts = shown.forms()
    if rival is not None:
        paired = [quantity for quantity in found.quantities if quantity.key in ("share", "against")]
        notes = [f"{quantity.title}: {quantity.about}." for quantity in paired]
        more = summary.table_over([("", found.overall)], paired)._replace(notes=notes)
        texts = ["\n\n".join(both) for both in zip(texts, more.forms(), strict=True)]
    return Comparison(rows, heading, unranked, page, *texts)


def _with(chosen: Sequence[Policy], rival: Policy | None, task: tasks.Task) -> list[Policy]:
    """The policies, then the ones that a comparison with ``rival`` needs."""
    more = [] if rival is None else [rival, make_policy(task.reference)]
    known = {policy.name for policy in chosen}
    return [*chosen, *({policy.name: policy for policy in more if policy.name not in known}.values())]


def _on_suite(
    chosen: Sequence[Policy], files: list[str], name: str, capacities: Any, seeds: Any, progress: bool, against: str
) -> Comparison:
    """``compare`` on the test split of a suite. Its processes know policies by name, or load them from ``files``."""
    registered = {*policies.names(), *policies.names(named_only=True)}
    for policy in chosen:
        base = policy.name.partition(":")[0]
        if base not in registered or policies.get(base).on_arrival is not policy.on_arrival:
            raise BufgymError(
                f"policy {policy.name}: register it to run it on a suite, whose processes know it by name"
            )
    if seeds is not None and not isinstance(seeds, int):
        raise BufgymError(f"seeds = {seeds!r}: on a suite, must be how many")
    names = tuple(policy.name for policy in chosen)
    sweep = Sweep(suites.get(name).name, names, "test", tuple(capacities), seeds, sources=tuple(dict.fromkeys(files)))
    # Other processes can't know what a user's own code registered in this one.
    own = not all(policy.built_in for policy in chosen) and not files
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        rows = run_sweep(sweep, out, jobs=1 if own else None, form="csv", progress=progress)
        suite, found = report.run_of(out, against)
        shown = tables.plain(suite, found), tables.markdown(suite, found), tables.html(found)
        return Comparison(rows, f"suite {name}", table.apart(chosen), partial(report.page_for, suite), *shown)

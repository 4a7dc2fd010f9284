"""The report of a training run: a table, a figure, JSON or rows, and the best agent, all in the run's folder."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from agents.constants import NAMES, UNTAUGHT
from agents.evaluation import EvaluationSet, sweep_for, test_rows
from agents.figure import draw
from agents.held_out import fixed_episodes, summarise, together
from agents.runs import Run, write_notes
from agents.settings import Settings
from bufgym.benchmark import summary
from bufgym.benchmark.bootstrap import Interval, written
from bufgym.benchmark.rows import Row, write_rows
from bufgym.benchmark.score import Scores, scores
from bufgym.benchmark.table import decimal, equal_rows_notes, unranked_among, with_equal_rows
from bufgym.benchmark.tasks import TASKS
from bufgym.oracle.measure import BASELINE
from bufgym.policies import Policy, registry
from bufgym.utils.files import shipped
from bufgym.utils.tables import aligned

COLUMNS = (
    ("QoI", "qoi", 1, 3),
    ("delivered", "delivered", 1, 1),
    ("dropped", "dropped", 1, 1),
    ("longest gap", "longest_gap", 1, 3),
    ("gap s", "longest_gap_s", 1, 2),
    ("sojourn ms", "mean_sojourn_s", 1000, 0),
    ("age ms", "mean_age_s", 1000, 0),
)
"""(heading, Outcome field, unit factor, digits)"""


def by_hand() -> list[str]:
    """Names of the ranked rules written by hand."""
    learned = shipped("agents", "agents/pretrained", "*.safetensors")
    return [name for name in registry.names(for_topics=False) if name not in learned and registry.get(name).ranked]


@dataclass(frozen=True)
class Trained:
    """A run whose training has ended."""

    settings: Settings
    folder: Path
    runs: Sequence[Run]
    agents: Sequence[Policy]
    """The agent that each run kept."""
    lines: Mapping[str, float] = field(default_factory=dict)
    """The validation scores to beat."""
    beside: Sequence[Trained] = ()
    """What other algorithms made of the same environment."""

    @property
    def best(self) -> Run:
        """Chosen by validation: choosing by the reported episodes would flatter it."""
        return max(self.runs, key=lambda run: run.merit)

    @property
    def seeds(self) -> list[int]:
        """Of all agents."""
        return [run.seed for run in self.runs]

    def save(self, home: Path, **results: Any) -> dict[str, Any]:
        """Write results.json; return the best agent's QoI, for its notes."""
        content = {
            "settings": {"algo": self.settings.algo, **self.settings.values},
            "seeds": self.seeds,
            "agent": agent_name(self.best),
            "training_s": {str(run.seed): run.seconds for run in self.runs},
            **results,
        }
        text = json.dumps(_without_nan(content), indent=2, allow_nan=False)
        (home / "results.json").write_text(text + "\n", encoding="utf-8")
        qoi = {row["policy"]: row["qoi"] for row in results["scores"]}
        return {"qoi": qoi[agent_name(self.best)], "drop-oldest": qoi["drop-oldest"], "held_out": results["held_out"]}


def _without_nan(content: Any) -> Any:
    """The content with null for numbers that JSON does not know."""
    if isinstance(content, Mapping):
        return {key: _without_nan(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_without_nan(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def keep(trained: Trained, report: Callable[[Trained], Report]) -> None:
    """Keep the best agent with its notes; print and save a report on the agents of all seeds."""
    best, folder = trained.best, trained.folder
    shutil.copyfile(best.model, folder / best.model.name)
    seeds, notes, contents = report(trained)
    write_notes(folder, trained.settings, seeds, notes)
    seconds = ", ".join(f"{run.seconds:.0f}" for way in (trained, *trained.beside) for run in way.runs)
    print(f"\ntraining took {seconds} s; {contents} are in {folder}")
    then = NEXT_OF_FLEET if trained.settings.kind == "fleet" else NEXT
    print("\n".join(["next:", *then]).format(model=folder / best.model.name))


def agent_name(run: Run) -> str:
    """Name of one seed's agent in tables."""
    return f"agent (seed {run.seed})"


NEXT = (
    "  bufgym play --policies {model}                # watch it decide",
    "  bufgym bench --policies {model},learned,afr   # compare it on other episodes, links and L",
    "  bufgym export {model} mine.safetensors --name mine",
)
"""What to do with a model."""
NEXT_OF_FLEET = (
    "  bufgym bench --suite fleet-v1 --policies {model},learned,afr   # compare it in other cells",
    NEXT[-1],
)

Report = tuple[list[int], dict[str, Any], str]
"""The seeds and scores for the notes of the kept agent, and what the folder holds."""


def report_rows(trained: Trained, rivals: Sequence[Policy]) -> Report:
    """Write every seed's agent beside the rivals on the test split: rows.csv, and the table in results.txt."""
    settings, folder = trained.settings, trained.folder
    agents: list[Any] = [
        dataclasses.replace(agent, name=agent_name(run))
        for run, agent in zip(trained.runs, trained.agents, strict=True)
        if isinstance(agent, Policy)
    ]
    rows = test_rows(settings, [*agents, *rivals])
    task = TASKS[settings.kind]
    write_rows(rows, folder / "rows.csv", task.layout)
    text = summary.table_of(task.summary(rows)).plain()
    (folder / "results.txt").write_text(text + "\n", encoding="utf-8")
    print(text)
    return trained.seeds, {}, f"best on validation: seed {trained.best.seed}; model and rows"


def report_environment(trained: Trained) -> Report:
    """Evaluate all agents and fixed policies on the held-out episodes."""
    settings, best = trained.settings, agent_name(trained.best)
    test = fixed_episodes(settings, "test")
    names, ways = {agent_name(run): run for run in trained.runs}, (trained, *trained.beside)
    agents = [*trained.agents]
    for way in trained.beside:
        names |= {f"agent by {way.settings.algo} (seed {run.seed})": run for run in way.runs}
        agents += way.agents
    outcomes = test.play_fixed() | {name: test.play(agent) for name, agent in zip(names, agents, strict=True)}
    rows = test.rows(outcomes)
    entries, alike = summarise(outcomes, rows, best), with_equal_rows(rows)
    seeds = {way.settings.algo: [(run.seed, name) for name, run in names.items() if run in way.runs] for way in ways}
    joined = together(rows, {algo: agents for algo, agents in seeds.items() if len(agents) > 1})
    unranked = unranked_among(map(registry.get, registry.names()))
    traces = [trace.name for trace in getattr(test.scenario, "traces", ())]
    over = "other links of this kind" if traces else "this kind"
    print(table(entries, best, alike, unranked))
    print(f"in brackets: 95 % intervals for other episodes of {over}" + f", from {len(traces)} links" * bool(traces))
    for algo, cell in joined.items():
        score, more = _text(cell.score, ".3f"), _text(cell.difference, "+.3f")
        print(f"{len(seeds[algo])} seeds of {algo} together: score {score}, QoI - AFR's {more}, for other seeds, too")
    for remark in scores(rows).remarks:
        print(remark)
    print(verdict(entries, best, trained.best.seconds, trained.settings.algo, over))
    held_out = {"episodes": len(test.episodes), "traces": traces}
    of_seeds = {algo: dataclasses.asdict(cell) for algo, cell in joined.items()}
    notes = trained.save(trained.folder, held_out=held_out, scores=entries, together=of_seeds)
    bars = {e["policy"]: Interval(e["score"], *e["score_95"]) for e in entries if e["policy"] not in unranked}
    bars, equals = _drawn(bars, alike)
    draw(
        trained.folder / "figure.png",
        {name: np.array(run.validation)[:, [1, 2]] for name, run in names.items()},
        ("training, s", f"score on {settings.validations()} validation episodes"),
        bars,
        f"{len(test.episodes)} episodes on held-out links" if traces else f"{len(test.episodes)} held-out episodes",
        lines=trained.lines,
        notes=equals,
    )
    return [trained.best.seed], notes, "model, figure and numbers"


def verdict(entries: Sequence[dict[str, Any]], agent: str, seconds: float, algo: str, over: str) -> str:
    """One sentence: the distance of the agent's score from rules and other agents, on episodes of what.

    First comes the better of the constant actions: what is not above it has learned nothing that shows.

    It is level with a policy where the 95 % interval of the difference in QoI has 0 in it.
    """
    known, rules = {entry["policy"]: entry for entry in entries}, by_hand()
    best = next(name for name in known if name in rules)  # the best first, as all entries are
    constant = next((name for name in known if name in NAMES[:-1]), "")
    others = [name for name in known if name.startswith("agent by ")]
    first = {name.partition(" (")[0]: name for name in reversed(others)}.values()  # the best seed of each algorithm
    rivals = {
        constant: f"the better constant action, {constant},",
        "afr": "AFR",
        best: f"the best rule written by hand, {best},",
        "target-gap": "target-gap",
        "learned": "learned",
    }
    lines = []
    for name, label in {**rivals, **{name: name for name in first}}.items():
        if name not in known:
            continue
        low, high = known[name]["minus_agent_95"]
        ahead = known[agent]["score"] - known[name]["score"]
        where = "above" if high < 0 else "below" if low > 0 else "level with"
        lines.append(f"{where} {label}" + (f" by {abs(ahead):.3f}" if where != "level with" else f" ({ahead:+.3f})"))
    reached = f"{known[agent]['score']:.3f} on episodes of {over}"
    return f"after {seconds:.0f} s {agent}, by {algo}, scores {reached}: {', '.join(lines)}"


def _drawn(bars: Mapping[str, Interval], alike: Mapping[str, Sequence[str]]) -> tuple[dict[str, Interval], list[str]]:
    """The bars to draw, and notes on bars that stand for several policies.

    Policies below Drop Oldest are only in the table, as they would squeeze the rest of the figure; agents are drawn.
    """
    others = {name for names in alike.values() for name in names}
    drawn = {name: bar for name, bar in bars.items() if name not in others}
    drawn = {name: bar for name, bar in drawn.items() if bar.value >= 0 or name.startswith("agent")}
    return drawn, [f"{first}: also {', '.join(names)}" for first, names in alike.items() if first in drawn]


def table(
    entries: Sequence[dict[str, Any]], agent: str, alike: Mapping[str, Sequence[str]], unranked: Mapping[str, str]
) -> str:
    """A table, best first, with the difference to the agent and its 95 % interval; ``alike`` policies share a line.

    The agent is marked. Policies that do not compete stand below a rule.
    """
    head = ["policy", "score [95 %]", *(heading for heading, *_ in COLUMNS), "QoI - agent's [95 %]"]
    others = {name for names in alike.values() for name in names}
    blocks: tuple[list[list[str]], list[list[str]]] = [], []
    for entry in entries:
        name = entry["policy"]
        if name in others:
            continue
        low, high = entry["minus_agent_95"]
        difference = "" if name == agent else f"{entry['minus_agent']:+.3f} [{low:+.3f}, {high:+.3f}]"
        score = _text(Interval(entry["score"], *entry["score_95"]), ".3f")
        numbers = [decimal(entry[column] * factor, digits) for _, column, factor, digits in COLUMNS]
        label = f"> {name}" if name == agent else name
        blocks[name in unranked].append([label, score, *numbers, difference])
    lines = aligned([head, *blocks[0], *blocks[1]])
    lines.insert(1 + len(blocks[0]), "-" * max(map(len, lines)))
    notes = [f"note: {name} does not compete: {unranked[name]}" for name in unranked if name not in others]
    return "\n".join([*lines, "score: 0 is Drop Oldest, 1 the clairvoyant", *notes, *equal_rows_notes(alike)])


def report_suites(trained: Trained) -> Report:
    """Score all agents on each suite, in a folder for each if there are several."""
    names, contents = trained.settings.suites.names, "model, rows, figure and numbers"
    if len(names) == 1:
        return [trained.best.seed], report_suite(trained, names[0], trained.folder)[0], contents
    notes: dict[str, Any] = {}
    for suite in names:
        print(f"\n{suite}")
        score = report_suite(trained, suite, trained.folder / suite)[1]
        if math.isfinite(score.value):
            notes[suite] = {"score": score.value, "interval": [score.low, score.high]}
    return trained.seeds, notes, contents


def report_suite(trained: Trained, suite: str, home: Path) -> tuple[dict[str, Any], Interval]:
    """Score all agents and fixed policies on the suite's test split, as ``bufgym bench`` does.

    The training seeds together are one entry, with intervals over seeds and over episodes. No choice is made here: each
    seed's agent, and the one in the run's folder, did best on validation.

    Returns:
        (the best agent's notes, the score of the agents together).
    """
    specs = tuple(registry.names(for_topics=False))
    settings, runs = trained.settings, trained.runs
    sweep = sweep_for(settings, suite, "test", specs, settings.suites.test_seeds or None)
    evaluation = EvaluationSet(sweep, trained.folder / "test" / suite, progress=True)
    home.mkdir(exist_ok=True)
    agents = {
        agent_name(run): evaluation.benchmark_rows(evaluation.play(agent), f"agent ({settings.algo})", run.seed)
        for run, agent in zip(runs, trained.agents, strict=True)
    }
    fixed = [evaluation.benchmark_rows(evaluation.play(policy), policy.name, None) for policy in UNTAUGHT]
    rows: list[Row] = [{**row, "training_seed": None} for row in evaluation.rows] + [
        row for own in fixed for row in own
    ]
    rows += [row for own in agents.values() for row in own]
    write_rows(rows, home / "rows.csv")
    result = scores(rows, unranked_among(map(registry.get, registry.names())))
    print(standings(result))
    qoi: dict[str, list[float]] = {}
    for row in rows:
        qoi.setdefault(row["policy"], []).append(row["qoi"])
    qoi |= {name: [row["qoi"] for row in own] for name, own in agents.items()}
    means = {name: float(np.mean(numbers)) for name, numbers in qoi.items()}
    notes = trained.save(
        home,
        validation={str(run.seed): run.reached for run in runs},
        held_out={"suite": suite, "split": "test", "episodes": len(evaluation.rows) // len(evaluation.sweep.specs)},
        scores=[{"policy": name, "qoi": mean} for name, mean in means.items()],
        standings=[dataclasses.asdict(standing) for standing in result.standings],
        cells=[dataclasses.asdict(cell) for cell in result.cells],
    )
    # Without a discriminative cell, there are no scores to draw.
    ranked = {s.policy: s["score"] for s in result.standings if s.ranked and math.isfinite(s["score"].value)}
    bars, equals = _drawn(ranked, with_equal_rows(rows))
    # By the last column the agent was chosen.
    curves = {agent_name(run): np.array(run.validation)[:, [1, -1]] for run in runs}
    labels = ("training, s", "regret over AFR's, on validation")
    draw(home / "figure.png", curves, labels, bars, "Test split", notes=equals)
    return notes, next(s["score"] for s in result.standings if s.policy == f"agent ({settings.algo})")


def standings(result: Scores) -> str:
    """Ranked policies first, best score first, with the 95 % intervals of the benchmark."""
    lines = [["policy", "score [95 %]", "regret [95 %]", "IQM", "P(better than AFR) [95 %]"]]
    for standing in result.standings:
        name = standing.policy if standing.ranked else f"{standing.policy} (not ranked)"
        iqm = "-" if math.isnan(standing["iqm"].value) else f"{standing['iqm'].value:.3f}"
        score, regret = (_text(standing["score"], ".3f"), _text(standing["regret"], ".2%"))
        lines.append([name, score, regret, iqm, _text(standing["improvement"], ".2f")])
    total = len({(cell.scenario, cell.capacity) for cell in result.cells})
    note = f"{result.counted} of {total} cells (scenario, L) count; score: 0 is {BASELINE}, 1 the clairvoyant"
    return "\n".join([*aligned(lines), note, *result.remarks])


def _text(interval: Interval, form: str) -> str:
    """An interval as text such as 1.03 [1.01, 1.05]."""
    return " ".join(filter(None, written(interval, lambda number: format(number, form))))

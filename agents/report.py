"""What comes out of a training run: a table, a figure, JSON or rows, and the best agent, all in the run's folder."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import training
from agents.evaluation import EvaluationSet, play, sweep_for, test_rows
from agents.held_out import held_out_episodes, run_fixed, split_scenario, summarise
from agents.mixed_env import Cell, MixedEnv
from agents.objectives import fleet, topics
from agents.page import written
from agents.runs import Run, write_notes
from agents.settings import Settings
from bufgym.benchmark import summary
from bufgym.benchmark.bootstrap import Interval
from bufgym.benchmark.rows import Row, write_rows
from bufgym.benchmark.score import Scores, scores
from bufgym.benchmark.table import aligned
from bufgym.benchmark.tasks import TASKS
from bufgym.policies import Policy, registry, weights

COLUMNS = (
    ("QoI", "qoi", 1, ".3f"),
    ("delivered", "delivered", 1, ".1f"),
    ("dropped", "dropped", 1, ".1f"),
    ("longest gap", "longest_gap", 1, ".3f"),
    ("gap s", "longest_gap_s", 1, ".2f"),
    ("sojourn ms", "mean_sojourn_s", 1000, ".0f"),
    ("age ms", "mean_age_s", 1000, ".0f"),
)
"""(heading, Outcome field, unit factor, format)"""


def report(settings: Settings, folder: Path, runs: Sequence[Run]) -> None:
    """Evaluate the agents of all seeds; print and save the results, and keep the best agent with its notes."""
    # Chosen by validation or training episodes: choosing by the reported ones would flatter it.
    best = max(runs, key=lambda run: run.merit)
    shutil.copyfile(best.model, folder / best.model.name)
    seeds, notes = [best.seed], {}
    contents = "model, rows, figure and numbers"
    if settings.kind in ("topics", "fleet"):
        seeds = [run.seed for run in runs]
        report_rows(settings, folder, runs)
        contents = f"best on validation: seed {best.seed}; model and rows"
    elif settings.kind == "environment":
        notes = report_environment(settings, folder, runs, best)
        contents = "model, figure and numbers"
    elif len(settings.suites) == 1:
        notes = report_suite(settings, settings.suite, folder, folder, runs, best)[0]
    else:
        seeds = [run.seed for run in runs]
        for suite in settings.suites:
            print(f"\n{suite}")
            score = report_suite(settings, suite, folder, folder / suite, runs, best)[1]
            if math.isfinite(score.value):
                notes[suite] = {"score": score.value, "interval": [score.low, score.high]}
    write_notes(folder, settings, seeds, notes)
    seconds = ", ".join(f"{run.seconds:.0f}" for run in runs)
    print(f"\ntraining took {seconds} s; {contents} are in {folder}")


def agent_name(run: Run) -> str:
    """What one seed's agent is called in tables."""
    return f"agent (seed {run.seed})"


def _save(home: Path, settings: Settings, runs: Sequence[Run], best: Run, **results: Any) -> dict[str, Any]:
    """Write results.json; the best agent's QoI, for its notes."""
    content = {
        "settings": dataclasses.asdict(settings),
        "seeds": [run.seed for run in runs],
        "agent": agent_name(best),
        "training_s": {str(run.seed): run.seconds for run in runs},
        **results,
    }
    (home / "results.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    qoi = {row["policy"]: row["qoi"] for row in results["scores"]}
    return {"qoi": qoi[agent_name(best)], "drop-oldest": qoi["drop-oldest"], "held_out": results["held_out"]}


# --- on many topics, or with many robots -----------------------------------------------------------------------------


RIVALS: dict[str, Callable[[], list[Policy]]] = {"topics": topics.rivals, "fleet": fleet.rivals}
"""Kind -> the fixed policies that its agents are measured against."""


def report_rows(settings: Settings, folder: Path, runs: Sequence[Run]) -> None:
    """Every seed's agent beside the fixed policies on the test split: rows.csv, and the table in results.txt."""
    agents = [dataclasses.replace(weights.load(run.model), name=agent_name(run)) for run in runs]
    rows = test_rows(settings, [*agents, *RIVALS[settings.kind]()])
    task = TASKS[settings.kind]
    write_rows(rows, folder / "rows.csv", task.layout)
    text = summary.plain(task.summary(rows))
    (folder / "results.txt").write_text(text + "\n", encoding="utf-8")
    print(text)


# --- on one environment ----------------------------------------------------------------------------------------------


def report_environment(settings: Settings, folder: Path, runs: Sequence[Run], best: Run) -> dict[str, Any]:
    """All agents and fixed policies on the held-out episodes; the best agent's notes."""
    scenario = split_scenario(settings)[1]
    episodes = held_out_episodes(scenario, settings.episodes)
    outcomes = run_fixed(episodes, scenario, settings.capacity)
    cell = Cell("held-out", scenario, settings.capacity)
    for run in runs:
        env = MixedEnv([cell], [len(episodes)], decide_at=settings.decide_at)
        outcomes[agent_name(run)] = play(training.load(settings, run), env, episodes)
    rows = summarise(outcomes, agent_name(best))
    print(table(rows, agent_name(best)))
    traces = [trace.name for trace in getattr(scenario, "traces", ())]
    held_out = {"episodes": len(episodes), "traces": traces}
    notes = _save(folder, settings, runs, best, held_out=held_out, scores=rows)
    measure = "QoI H, mean of the latest training episodes"
    qoi = {row["policy"]: row["qoi"] for row in rows}
    curves = [np.array(run.curve).reshape(-1, 3)[:, [0, 2]] for run in runs]
    draw(folder / "figure.png", runs, curves, measure, qoi, "QoI H, mean", "Held-out episodes")
    return notes


def table(rows: Sequence[dict[str, Any]], agent: str) -> str:
    """Best QoI first, with the difference to the agent and its 95 % interval."""
    lines = [["policy", *(heading for heading, *_ in COLUMNS), "QoI - agent's [95 %]"]]
    for row in rows:
        low, high = row["minus_agent_95"]
        difference = "" if row["policy"] == agent else f"{row['minus_agent']:+.3f} [{low:+.3f}, {high:+.3f}]"
        lines.append(
            [row["policy"], *(format(row[name] * factor, spec) for _, name, factor, spec in COLUMNS), difference]
        )
    return "\n".join(aligned(lines))


# --- on a suite ------------------------------------------------------------------------------------------------------


def report_suite(
    settings: Settings, suite: str, folder: Path, home: Path, runs: Sequence[Run], best: Run
) -> tuple[dict[str, Any], Interval]:
    """All agents and fixed policies on the suite's test split, scored as ``bufgym bench`` does.

    The training seeds together are one entry, with intervals over them and over episodes. Nothing is chosen here: each
    seed's agent, and the one in the run's folder, are those that did best on validation.

    Returns:
        (the best agent's notes, the score of the agents together).
    """
    specs = tuple(registry.names(for_topics=False))
    sweep = sweep_for(settings, suite, "test", specs, settings.test_seeds or None)
    evaluation = EvaluationSet(sweep, folder / "test" / suite, progress=True)
    home.mkdir(exist_ok=True)
    agents = {agent_name(run): training.test_rows(settings, run, evaluation) for run in runs}
    rows: list[Row] = [{**row, "training_seed": None} for row in evaluation.rows]
    rows += [row for own in agents.values() for row in own]
    write_rows(rows, home / "rows.csv")
    result = scores(rows, unranked=[name for name in registry.names() if not registry.get(name).ranked])
    print(standings(result))
    qoi: dict[str, list[float]] = {}
    for row in rows:
        qoi.setdefault(row["policy"], []).append(row["qoi"])
    qoi |= {name: [row["qoi"] for row in own] for name, own in agents.items()}
    means = {name: float(np.mean(numbers)) for name, numbers in qoi.items()}
    notes = _save(
        home,
        settings,
        runs,
        best,
        validation={str(run.seed): run.reached for run in runs},
        held_out={"suite": suite, "split": "test", "episodes": len(evaluation.rows) // len(evaluation.sweep.specs)},
        scores=[{"policy": name, "qoi": mean} for name, mean in means.items()],
        standings=[dataclasses.asdict(standing) for standing in result.standings],
        cells=[dataclasses.asdict(cell) for cell in result.cells],
    )
    # Policies below Drop Oldest are in the table alone: they would squeeze the rest of the figure.
    drawn = [s for s in result.standings if s.ranked and (s.score.value >= 0 or s.policy.startswith("agent"))]
    # Where no cell is discriminative, there are no scores to draw.
    bars = {s.policy: s.score.value for s in drawn if math.isfinite(s.score.value)} or means
    rival = "that of AFR or Drop Oldest" if settings.algo == "evolution" else "AFR's"
    # By the last column the agent was chosen.
    curves = [np.array(run.validation)[:, [0, -1]] for run in runs]
    measure = f"regret over {rival}, on validation"
    draw(home / "figure.png", runs, curves, measure, bars, "normalised score", "Test split")
    return notes, next(s.score for s in result.standings if s.policy == f"agent ({settings.algo})")


def standings(result: Scores) -> str:
    """Ranked policies first, best score first, with the 95 % intervals of the benchmark."""
    lines = [["policy", "score [95 %]", "regret [95 %]", "IQM", "P(better than AFR) [95 %]"]]
    for standing in result.standings:
        name = standing.policy if standing.ranked else f"{standing.policy} (not ranked)"
        iqm = "-" if math.isnan(standing.iqm.value) else f"{standing.iqm.value:.3f}"
        score, regret = written(standing.score, ".3f"), written(standing.regret, ".2%")
        lines.append([name, score, regret, iqm, written(standing.improvement, ".2f")])
    counted = max((standing.cells for standing in result.standings), default=0)
    total = len({(cell.scenario, cell.capacity) for cell in result.cells})
    note = f"{counted} of {total} cells (scenario, L) count; score: 0 is {result.baseline}, 1 the clairvoyant"
    return "\n".join([*aligned(lines), note])


# --- the figure ------------------------------------------------------------------------------------------------------


def draw(
    path: Path,
    runs: Sequence[Run],
    curves: Sequence[NDArray[Any]],
    measure: str,
    bars: Mapping[str, float],
    unit: str,
    title: str,
) -> None:
    """Learning curves on the left, every policy's result on the right.

    Args:
        path: the picture.
        runs: one a curve.
        curves: (steps, measure) of each run, float[rows, 2].
        measure: what the curves show.
        bars: policy -> result, best first.
        unit: what the results are.
        title: where they were reached.
    """
    if importlib.util.find_spec("matplotlib") is None:
        print("no figure: matplotlib is not installed")
        return
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2 + 0.12 * max(0, len(bars) - 12)), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for run, curve in zip(runs, curves, strict=True):
        left.plot(curve[:, 0] / 1e6, curve[:, 1], label=f"seed {run.seed}")
    left.set(xlabel="decisions, millions", ylabel=measure, title="Training")
    left.grid(alpha=0.3)
    if len(runs) > 1:
        left.legend(frameon=False)
    names, numbers = list(bars)[::-1], list(bars.values())[::-1]
    colours = ["tab:orange" if name.startswith("agent") else "tab:blue" for name in names]
    right.bar_label(right.barh(names, numbers, color=colours), fmt="%.3f", padding=3)
    spread = max(numbers) - min(numbers) or 1.0
    low = min(numbers) - 0.15 * spread
    right.set(xlabel=f"{unit} (axis does not start at 0)" if low > 0 else unit, title=title)
    right.set_xlim(low, max(numbers) + 0.2 * spread)
    right.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)

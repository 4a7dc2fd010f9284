"""What came out of a training run: a table, a figure, and JSON, all in the run's folder."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluate import held_out, run_agent, run_fixed, summarise, worlds
from agents.training import ALGORITHMS, Run, load
from agents.trials import Trials, plan
from bufgym.benchmark.rows import Row, write_rows
from bufgym.benchmark.score import Interval, Scores, scores
from bufgym.benchmark.table import aligned
from bufgym.policies import registry

if TYPE_CHECKING:
    from train import Arguments

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


def evaluate_and_report(arguments: Arguments, folder: Path, runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Evaluate all agents and fixed policies on the held-out episodes; print and save what came of it."""
    world = worlds(arguments)[1]
    episodes = held_out(world, arguments.episodes)
    results = run_fixed(episodes, world, arguments.capacity)
    # Chosen by its training episodes: choosing by the held-out ones would flatter it.
    best = max(runs, key=lambda run: run.merit)
    for run in runs:
        model = load(arguments, run)
        results[agent_name(run)] = run_agent(model, episodes, world, arguments.capacity, arguments.decide_at)
    shutil.copyfile(best.model, folder / "model.zip")
    rows = summarise(results, agent_name(best))
    print(table(rows, agent_name(best)))
    saved = {
        "settings": dataclasses.asdict(arguments),
        "seeds": [run.seed for run in runs],
        "agent": agent_name(best),
        "training_s": {str(run.seed): run.seconds for run in runs},
        "held_out": {"episodes": len(episodes), "traces": [trace.name for trace in getattr(world, "traces", ())]},
        "scores": rows,
    }
    (folder / "results.json").write_text(json.dumps(saved, indent=2) + "\n", encoding="utf-8")
    draw(rows, runs, folder / "figure.png")
    seconds = ", ".join(f"{run.seconds:.0f}" for run in runs)
    print(f"\ntraining took {seconds} s; model, figure and numbers are in {folder}")
    return rows


def agent_name(run: Run) -> str:
    return f"agent (seed {run.seed})"


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


def draw(rows: Sequence[dict[str, Any]], runs: Sequence[Run], path: Path) -> None:
    """Learning curves on the left, held-out QoI of every policy on the right."""
    shown = {row["policy"]: row["qoi"] for row in rows}
    curves = [np.array(run.curve).reshape(-1, 3)[:, [0, 2]] for run in runs]
    _figure(
        path, runs, curves, "QoI H, mean of the latest training episodes", shown, "QoI H, mean", "Held-out episodes"
    )


def _figure(
    path: Path,
    runs: Sequence[Run],
    curves: Sequence[NDArray[Any]],
    measure: str,
    reached: Mapping[str, float],
    unit: str,
    title: str,
) -> None:
    """``curves``: (steps, measure) of each run; ``reached``: best first."""
    if importlib.util.find_spec("matplotlib") is None:
        print("no figure: matplotlib is not installed")
        return
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2 + 0.12 * max(0, len(reached) - 12)), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for run, curve in zip(runs, curves, strict=True):
        left.plot(curve[:, 0] / 1e6, curve[:, 1], label=f"seed {run.seed}")
    left.set(xlabel="decisions, millions", ylabel=measure, title="Training")
    left.grid(alpha=0.3)
    if len(runs) > 1:
        left.legend(frameon=False)
    names, numbers = list(reached)[::-1], list(reached.values())[::-1]
    colours = ["tab:orange" if name.startswith("agent") else "tab:blue" for name in names]
    bars = right.barh(names, numbers, color=colours)
    right.bar_label(bars, fmt="%.3f", padding=3)
    spread = max(numbers) - min(numbers) or 1.0
    low = min(numbers) - 0.15 * spread
    right.set(xlabel=f"{unit} (axis does not start at 0)" if low > 0 else unit, title=title)
    right.set_xlim(low, max(numbers) + 0.2 * spread)
    right.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)


# --- on a suite ------------------------------------------------------------------------------------------------------


def report_suites(arguments: Arguments, folder: Path, runs: Sequence[Run]) -> dict[str, Scores]:
    """Each suite's table, in the run's folder or, of several suites, in one of its own; the best agent is kept."""
    best = max(runs, key=lambda run: run.merit)
    shutil.copyfile(best.model, folder / best.model.name)
    several = len(arguments.suites) > 1
    found = {}
    for suite in arguments.suites:
        if several:
            print(f"\n{suite}")
        found[suite] = report_suite(arguments, suite, folder, folder / suite if several else folder, runs)
    seconds = ", ".join(f"{run.seconds:.0f}" for run in runs)
    print(f"\ntraining took {seconds} s; model, rows, figure and numbers are in {folder}")
    return found


def report_suite(arguments: Arguments, suite: str, folder: Path, home: Path, runs: Sequence[Run]) -> Scores:
    """All agents and fixed policies on the suite's test split, scored as ``bufgym bench`` does; print and save it.

    The training seeds together are one entry, with intervals over them and over episodes. Nothing is chosen here: each
    seed's agent, and the one in model.zip, are those that did best on validation.
    """
    test = plan(arguments, suite, "test", tuple(registry.names(for_topics=False)), arguments.test_seeds or None)
    trials = Trials(test, folder / "test" / suite, progress=True)
    home.mkdir(exist_ok=True)
    best = max(runs, key=lambda run: run.merit)
    agents = {run.seed: ALGORITHMS[arguments.algo].test(arguments, run, trials) for run in runs}
    rows: list[Row] = [{**row, "training_seed": None} for row in trials.rows]
    rows += [row for seed in agents for row in agents[seed]]
    write_rows(rows, home / "rows.csv")
    unranked = [name for name in registry.names() if not registry.get(name).ranked]
    found = scores(rows, unranked=unranked)
    print(standings(found))
    qoi: dict[str, list[float]] = {}
    for row in rows:
        qoi.setdefault(row["policy"], []).append(row["qoi"])
    qoi |= {f"agent (seed {seed})": [row["qoi"] for row in agents[seed]] for seed in agents}
    saved = {
        "settings": dataclasses.asdict(arguments),
        "seeds": [run.seed for run in runs],
        "agent": agent_name(best),
        "training_s": {str(run.seed): run.seconds for run in runs},
        "validation": {str(run.seed): -run.merit for run in runs},
        "held_out": {"suite": suite, "split": "test", "episodes": len(trials.rows) // len(trials.plan.specs)},
        "scores": [{"policy": name, "qoi": float(np.mean(numbers))} for name, numbers in qoi.items()],
        "standings": [dataclasses.asdict(standing) for standing in found.standings],
        "cells": [dataclasses.asdict(cell) for cell in found.cells],
    }
    (home / "results.json").write_text(json.dumps(saved, indent=2) + "\n", encoding="utf-8")
    # What is below Drop Oldest is in the table alone: it would squeeze the rest.
    shown = [s for s in found.standings if s.ranked and (s.score.value >= 0 or s.policy.startswith("agent"))]
    # Where no cell discriminative there is nothing to score.
    shown = [s for s in shown if math.isfinite(s.score.value)]
    reached = {s.policy: s.score.value for s in shown} or {
        name: float(np.mean(numbers)) for name, numbers in qoi.items()
    }
    # By the last column the agent was chosen.
    curves = [np.array(run.validation)[:, [0, -1]] for run in runs]
    measure = f"regret over {ALGORITHMS[arguments.algo].rival}, on validation"
    _figure(home / "figure.png", runs, curves, measure, reached, "normalised score", "Test split")
    return found


def standings(found: Scores) -> str:
    """Ranked policies first, best score first, with the intervals of the benchmark."""
    lines = [["policy", "score", "95 %", "regret", "95 %", "IQM", "P(better than AFR)", "95 %"]]
    for standing in found.standings:
        cells = []
        for interval, spec in ((standing.score, ".3f"), (standing.regret, ".2%")):
            cells += [_number(interval.value, spec), _span(interval, spec)]
        better = [_number(standing.improvement.value, ".2f"), _span(standing.improvement, ".2f")]
        name = standing.policy if standing.ranked else f"{standing.policy} (not ranked)"
        lines.append([name, *cells, _number(standing.iqm.value, ".3f"), *better])
    discriminative = max((standing.cells for standing in found.standings), default=0)
    total = len({(cell.scenario, cell.capacity) for cell in found.cells})
    note = f"{discriminative} of {total} cells (scenario, L) count; score: 0 is {found.baseline}, 1 the clairvoyant"
    return "\n".join([*aligned(lines), note])


def _number(number: float, spec: str) -> str:
    return "-" if math.isnan(number) else format(number, spec)


def _span(interval: Interval, spec: str) -> str:
    return "" if math.isnan(interval.low) else f"[{interval.low:{spec}}, {interval.high:{spec}}]"

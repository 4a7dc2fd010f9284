"""What came out of a training run: a table, a figure, and JSON, all in the run's folder."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from sb3_contrib import MaskablePPO

from agents.evaluate import held_out, run_agent, run_fixed, summarise, worlds
from agents.training import Run
from bufgym.benchmark.table import aligned

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
    best = max(runs, key=lambda run: run.score)
    for run in runs:
        model = MaskablePPO.load(run.model, device="cpu")
        results[agent_name(run)] = run_agent(model, episodes, world, arguments.capacity, arguments.decide_at)
        if run is best:
            export(model, folder)
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


def export(model: MaskablePPO, folder: Path) -> None:
    """The weights as plain numbers: unlike model.zip, reading them never runs code."""
    if importlib.util.find_spec("safetensors") is None:
        return
    from safetensors.numpy import save_file

    weights = {name: np.ascontiguousarray(tensor.numpy()) for name, tensor in model.policy.state_dict().items()}
    fields = ",".join(getattr(model.observation_space, "spaces", {}))
    save_file(weights, folder / "weights.safetensors", metadata={"fields": fields})


def draw(rows: Sequence[dict[str, Any]], runs: Sequence[Run], path: Path) -> None:
    """Learning curves on the left, held-out QoI of every policy on the right."""
    if importlib.util.find_spec("matplotlib") is None:
        print("no figure: matplotlib is not installed")
        return
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for run in runs:
        curve = np.array(run.curve).reshape(-1, 3)
        left.plot(curve[:, 0] / 1e6, curve[:, 2], label=f"seed {run.seed}")
    left.set(xlabel="decisions, millions", ylabel="QoI H, mean of the latest episodes", title="Training")
    left.grid(alpha=0.3)
    if len(runs) > 1:
        left.legend(frameon=False)
    shown = rows[::-1]
    colours = ["tab:orange" if row["policy"].startswith("agent") else "tab:blue" for row in shown]
    qoi = [row["qoi"] for row in shown]
    bars = right.barh([row["policy"] for row in shown], qoi, color=colours)
    right.bar_label(bars, fmt="%.3f", padding=3)
    spread = max(qoi) - min(qoi) or 1.0
    right.set(xlabel="QoI H, mean (axis does not start at 0)", title="Held-out episodes")
    right.set_xlim(min(qoi) - 0.15 * spread, max(qoi) + 0.2 * spread)
    right.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)

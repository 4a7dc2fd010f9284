"""What each part of an evolved agent is worth: the same training without it, as a page.

``python -m agents.ablation --steps 40000000 --seeds 2 --out docs/ablation.md`` trains every variant, a process a core
(a finished one is not trained again), and measures the kept agents on the test splits: regret over that of AFR or Drop
Oldest, whichever is better (``grounds.Yard``). ``--runs runs/a,runs/b`` adds how those runs of ``train.py`` learned, by
whatever algorithm, and what more seeds are worth to the evolved ones.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import csv
import itertools
import json
import multiprocessing
import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents import evolution
from agents.export import command
from agents.grounds import EPISODES
from agents.training import ALGORITHMS, prepare
from agents.trials import ValidationSet
from bufgym import policies
from bufgym.errors import BufgymError
from bufgym.policies import weights
from train import Arguments

SUITES = "interruption-v1,lte-v1,outage-v1,sustained-v1"
TEST_SEED = 2

WITHOUT = {
    "everything": (),
    "without value (loss, relative_loss, even_value, bend)": ("loss", "relative_loss", "even_value", "bend"),
    "without its curvature (relative_loss, even_value, bend)": ("relative_loss", "even_value", "bend"),
    "without link (stalled, drain)": ("stalled", "service_ratio"),
    "without context, so nothing is mixed": ("occupancy", "stalled", "service_ratio", "even_value", "bend"),
    "rank and motion_merged alone": tuple(name for name in evolution.MOTION if name not in ("rank", "motion_merged")),
}
"""Fields left out of ``evolution.MOTION``."""
HIDDEN = ((4, 0), (4, 3), (4, 12))
"""Hidden units beside the mixing: those of the scorer of links that move, and of links that stand still."""


def variants(given: Arguments) -> dict[str, Arguments]:
    """Name -> how to train it."""
    made = {}
    for name, left_out in WITHOUT.items():
        fields = [field for field in evolution.MOTION if field not in left_out]
        made[name] = replace(given, fields=",".join(fields))
    made["on time alone (--sees time)"] = replace(given, sees="time")
    for hidden, still in HIDDEN:
        units = replace(given, hidden=hidden, still_hidden=still)
        made[f"{hidden} hidden units where the link moves, {still} where it stands still"] = units
    if len(given.suites) > 1:
        made["one scorer for all links"] = replace(given, warm_up=0, hidden=given.still_hidden)
    return {name: replace(arguments, name=f"{given.name}/{k:02d}") for k, (name, arguments) in enumerate(made.items())}


def trained(arguments: Arguments, seed: int) -> list[float]:
    """Train one variant with one seed, or find what was trained; its measure on the test split of every suite."""
    folder = Path("runs") / arguments.name
    result = folder / f"seed-{seed}" / "test.json"
    if not result.exists():
        run = ALGORITHMS["evolution"].train(arguments, folder, seed, 0)
        agent = policies.load(run.model)
        yards = evolution.yards(arguments, "test", TEST_SEED, 3 * EPISODES)
        result.write_text(json.dumps([yard.over_rivals(agent) for yard in yards]), encoding="utf-8")
    found: list[float] = json.loads(result.read_text(encoding="utf-8"))
    return found


def table(found: dict[str, list[list[float]]], sizes: dict[str, int], suites: Sequence[str]) -> list[str]:
    """Markdown: a row a variant, mean over its seeds, and the range of the mean over the suites."""
    lines = [f"| variant | numbers | {' | '.join(suites)} | mean (seeds) |", "|---" * (len(suites) + 3) + "|"]
    for name, seeds in found.items():
        by_suite = " | ".join(f"{number:.2f}" for number in np.mean(seeds, axis=0))
        means = np.mean(seeds, axis=1)
        lines.append(
            f"| {name} | {sizes[name]} | {by_suite} | {means.mean():.3f} ({means.min():.3f}-{means.max():.3f}) |"
        )
    return lines


MOMENTS_S = (0, 15, 30, 60, 120, 180)


def learning(runs: Sequence[Path]) -> list[str]:
    """Markdown: the best regret over AFR's on validation after so many seconds, for every seed of these runs."""
    lines = [
        f"| run | algorithm | seed | {' | '.join(f'{s} s' for s in MOMENTS_S)} | at the end |",
        "|---" * (len(MOMENTS_S) + 4) + "|",
    ]
    for run in runs:
        for path in sorted(run.glob("seed-*/validation.csv")):
            with path.open(newline="", encoding="utf-8") as file:
                rows = [(float(row["seconds"]), float(row["over_afr"])) for row in csv.DictReader(file)]
            cells = []
            for moment in MOMENTS_S:
                reached = [over for seconds, over in rows if seconds <= moment + 2]
                cells.append(f"{min(reached):.2f}" if reached and rows[-1][0] >= moment - 2 else "")
            end = f"{min(over for _, over in rows):.2f} ({rows[-1][0]:.0f} s)"
            algo = _settings(run)["algo"]
            lines.append(f"| {run.name} | {algo} | {path.parent.name[5:]} | {' | '.join(cells)} | {end} |")
    return [*lines, "", "```", *(f"{command(_settings(run))} --name {run.name}" for run in runs), "```"]


def _settings(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "settings.json").read_text(encoding="utf-8"))
    return found


def more_seeds(run: Path) -> list[str]:
    """Markdown: what the best of n seeds by validation is on the test splits, on average over all choices of n.

    Both as the regret over that of AFR or Drop Oldest, whichever is better, mean over the run's suites.
    """
    given = Arguments(**_settings(run))
    found = []
    for path in sorted(run.glob("seed-*/validation.csv")):
        with path.open(newline="", encoding="utf-8") as file:
            chosen_by = min(float(row["over_rivals"]) for row in csv.DictReader(file))
        agent = policies.load(path.parent / evolution.MODEL)
        yards = evolution.yards(given, "test", TEST_SEED, 3 * EPISODES)
        found.append((chosen_by, float(np.mean([yard.over_rivals(agent) for yard in yards]))))
    lines = [f"| {run.name}: seeds | validation | test |", "|---|---|---|"]
    for n in range(1, len(found) + 1):
        best = [min(some) for some in itertools.combinations(found, n)]
        validation, test = np.mean(best, axis=0)
        lines.append(f"| best of {n} | {validation:.3f} | {test:.3f} |")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m agents.ablation", description=__doc__)
    parser.add_argument("--name", default="ablation", help="folder under runs/")
    parser.add_argument("--steps", type=int, default=40_000_000)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--suites", default=SUITES)
    parser.add_argument("--runs", default="", help="folders of runs whose learning is shown beside")
    parser.add_argument("--out", type=Path, default=None, help="Markdown file to write; printed otherwise")
    options = parser.parse_args(arguments)
    given = Arguments(suite=options.suites, algo="evolution", name=options.name, steps=options.steps, hidden=4)
    # Where there is nothing but interruptions, the link never moves.
    share = 1 if options.suites == "interruption-v1" else 2
    given = replace(given, validate_every=options.steps // 5, warm_up=options.steps // share)
    try:
        todo = variants(given)
        first, *others = todo.values()
        solved = Path("runs") / first.name / "validation"
        if not solved.exists():
            ValidationSet(first, prepare(first))
        for chosen in others:  # all meet the same validation episodes, whose bounds are found once
            if not (Path("runs") / chosen.name).exists():
                shutil.copytree(solved, prepare(chosen) / "validation")
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
            jobs = {name: [pool.submit(trained, a, s) for s in range(options.seeds)] for name, a in todo.items()}
            found = {name: [job.result() for job in each] for name, each in jobs.items()}
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None
    sizes = {}
    for name, chosen in todo.items():
        kept, _ = weights.read(Path("runs") / chosen.name / "seed-0" / evolution.MODEL)
        sizes[name] = sum(len(evolution.to_vector(each)) for each in (kept, kept.still) if each)
    seen = f" --suites {options.suites}" if options.suites != SUITES else ""
    seen += f" --runs {options.runs}" if options.runs else ""
    lines = [
        "# What each part is worth",
        "",
        "Test splits; regret over that of AFR or Drop Oldest, whichever is better. "
        f"{options.steps:,} decisions a seed, {given.warm_up:,} of them for the scorer of a still link; "
        f'{options.seeds} seeds, whose range is in parentheses: what lies within it is luck. "Everything" has '
        f"{given.hidden} hidden units where the link moves and {given.still_hidden} where it stands still. Made by",
        "",
        f"`python -m agents.ablation --steps {options.steps} --seeds {options.seeds}{seen}`",
        "",
        *table(found, sizes, given.suites),
        "",
    ]
    if options.runs:
        runs = [Path(run) for run in options.runs.split(",")]
        told = "Best regret over AFR's on validation so far, mean over the suites; a run ends where it was stopped."
        lines += ["## How they learned", "", told, ""]
        lines += [*learning(runs), "", "## What more seeds are worth", ""]
        for run in runs:
            if _settings(run)["algo"] == "evolution" and _settings(run)["seeds"] > 2:
                lines += [*more_seeds(run), ""]
    text = "\n".join(lines)
    if options.out:
        options.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()

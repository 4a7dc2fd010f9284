"""The worth of each part of an evolved agent, as a page: the same training without that part.

``python -m agents.ablation --steps 40000000 --seeds 2 --out docs/ablation.md`` trains every unfinished variant, one
process per core. It measures the kept agents on the test splits, by regret over that of AFR or Drop Oldest, whichever
is better (``objectives.queue.SuiteObjective``). ``--runs runs/a,runs/b`` adds the learning curves of those ``train.py``
runs, by any algorithm, and the gain of more seeds for evolved agents.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from agents import cma_es
from agents.evaluation import ValidationSets
from agents.objectives.objective import to_vector
from agents.objectives.queue import EPISODES, suite_objectives
from agents.page import columns_of, command, publish, table
from agents.runs import MODEL, RUNS, pool_of, prepare, read_settings
from agents.settings import MOTION, Settings
from bufgym import policies
from bufgym.policies import weights

SUITES = "interruption-v1,lte-v1,outage-v1,sustained-v1"
TEST_SEED = 2

WITHOUT = {
    "everything": (),
    "without value (loss, relative_loss, even_value, bend)": ("loss", "relative_loss", "even_value", "bend"),
    "without its curvature (relative_loss, even_value, bend)": ("relative_loss", "even_value", "bend"),
    "without link (stalled, service_ratio)": ("stalled", "service_ratio"),
    "without context, so nothing is mixed": ("occupancy", "stalled", "service_ratio", "even_value", "bend"),
    "rank and motion_merged alone": tuple(name for name in MOTION if name not in ("rank", "motion_merged")),
}
"""Fields left out of ``settings.MOTION``."""
HIDDEN = ((4, 0), (4, 3), (4, 12))
"""Hidden units beside the mixing: in the scorer of moving links, and in the scorer of links that stand still."""


def variants(base: Settings) -> dict[str, Settings]:
    """Name -> settings of its training."""
    by_name = {}
    for name, left_out in WITHOUT.items():
        by_name[name] = replace(base, fields=",".join(field for field in MOTION if field not in left_out))
    by_name["on time alone (--sees time)"] = replace(base, sees="time")
    for hidden, still in HIDDEN:
        units = replace(base, hidden=hidden, still_hidden=still)
        by_name[f"{hidden} hidden units where the link moves, {still} where it stands still"] = units
    if len(base.suites) > 1:
        by_name["one scorer for all links"] = replace(base, warm_up=0, hidden=base.still_hidden)
    return {name: replace(variant, name=f"{base.name}/{k:02d}") for k, (name, variant) in enumerate(by_name.items())}


def tested(settings: Settings, model: Path) -> list[float]:
    """The kept agent's regret over the rivals' on the test split of every suite."""
    agent = policies.load(model)
    objectives = suite_objectives(settings, "test", TEST_SEED, 3 * EPISODES)
    return [objective.over_rivals(agent) for objective in objectives]


def trained(settings: Settings, seed: int) -> list[float]:
    """Train one variant with one seed and test it, or read the result of an earlier call."""
    folder = RUNS / settings.name
    file = folder / f"seed-{seed}" / "test.json"
    if not file.exists():
        run = cma_es.train(settings, folder, seed)
        file.write_text(json.dumps(tested(settings, run.model)), encoding="utf-8")
    measured: list[float] = json.loads(file.read_text(encoding="utf-8"))
    return measured


def variants_table(
    measured: Mapping[str, Sequence[Sequence[float]]], sizes: Mapping[str, int], suites: Sequence[str]
) -> list[str]:
    """Markdown: a row per variant, with the mean over its seeds and the range of the mean over the suites."""
    rows = []
    for name, seeds in measured.items():
        means = np.mean(seeds, axis=1)
        overall = f"{means.mean():.3f} ({means.min():.3f}-{means.max():.3f})"
        rows.append([name, sizes[name], *(f"{number:.2f}" for number in np.mean(seeds, axis=0)), overall])
    return table(["variant", "numbers", *suites, "mean (seeds)"], rows)


MOMENTS_S = (0, 15, 30, 60, 120, 180)


def learning(runs: Sequence[Path]) -> list[str]:
    """Markdown: the best regret over AFR's on validation after some training times, for every seed of these runs."""
    rows = []
    for run in runs:
        for path in sorted(run.glob("seed-*/validation.csv")):
            validations = columns_of(path, "seconds", "over_afr")
            end_s = validations[-1][0]
            bests = []
            for moment in MOMENTS_S:
                reached = [over for seconds, over in validations if seconds <= moment + 2]
                bests.append(f"{min(reached):.2f}" if reached and end_s >= moment - 2 else "")
            end = f"{min(over for _, over in validations):.2f} ({end_s:.0f} s)"
            rows.append([run.name, read_settings(run)["algo"], path.parent.name[5:], *bests, end])
    head = ["run", "algorithm", "seed", *(f"{s} s" for s in MOMENTS_S), "at the end"]
    commands = [f"{read_settings(run)['command']} --name {run.name}" for run in runs]
    return [*table(head, rows), "", "```", *commands, "```"]


def more_seeds(run: Path) -> list[str]:
    """Markdown: test results of the best of n seeds by validation, on average over all choices of n.

    The measure is the regret over that of AFR or Drop Oldest, whichever is better, mean over the run's suites.
    """
    values = read_settings(run)
    settings = Settings(**{field.name: values[field.name] for field in fields(Settings)})
    pairs = []
    for path in sorted(run.glob("seed-*/validation.csv")):
        chosen_by = min(over for (over,) in columns_of(path, "over_rivals"))
        pairs.append((chosen_by, float(np.mean(tested(settings, path.parent / MODEL)))))
    rows = []
    for n in range(1, len(pairs) + 1):
        validation, test = np.mean([min(some) for some in itertools.combinations(pairs, n)], axis=0)
        rows.append([f"best of {n}", f"{validation:.3f}", f"{test:.3f}"])
    return table([f"{run.name}: seeds", "validation", "test"], rows)


def train_variants(by_name: Mapping[str, Settings], seeds: int) -> dict[str, list[list[float]]]:
    """Results of every variant's seeds on the test splits."""
    first, *others = by_name.values()
    validation = RUNS / first.name / "validation"
    if not validation.exists():
        ValidationSets(first, prepare(first))
    for variant in others:  # all share the validation episodes, whose bounds are computed once
        if not (RUNS / variant.name).exists():
            shutil.copytree(validation, prepare(variant) / "validation")
    with pool_of(os.cpu_count() or 1) as pool:
        jobs = {
            name: [pool.submit(trained, variant, seed) for seed in range(seeds)] for name, variant in by_name.items()
        }
        return {name: [job.result() for job in own] for name, own in jobs.items()}


def main(
    name: str = "ablation",
    steps: int = 40_000_000,
    seeds: int = 2,
    suites: str = SUITES,
    runs: str = "",
    out: Path | None = None,
) -> None:
    """The worth of each part of an evolved agent: train what is missing, and make the page.

    Args:
        name: folder under runs/.
        steps: decisions a seed.
        seeds: seeds a variant.
        suites: suites to train and test on.
        runs: folders of runs whose learning curves are added.
        out: Markdown file to write; the page is printed in any case.
    """
    base = Settings(suite=suites, algo="evolution", name=name, steps=steps, hidden=4)
    # With nothing but interruptions, the link never moves.
    share = 1 if suites == "interruption-v1" else 2
    base = replace(base, validate_every=steps // 5, warm_up=steps // share)
    by_name = variants(base)
    measured = train_variants(by_name, seeds)
    sizes = {}
    for label, variant in by_name.items():
        kept, _ = weights.read(RUNS / variant.name / "seed-0" / MODEL)
        sizes[label] = sum(len(to_vector(scorer)) for scorer in (kept, kept.still) if scorer)
    chosen = f" --suites {suites}" if suites != SUITES else ""
    chosen += f" --runs {runs}" if runs else ""
    lines = [
        "# What each part is worth",
        "",
        "The figure is the regret on the test splits over the regret of AFR or Drop Oldest, whichever is better. "
        f"Each seed trains on {steps:,} decisions, {base.warm_up:,} of them for the scorer of a still link. "
        f"There are {seeds} seeds, and parentheses hold their range. Differences within the range are noise. "
        '"Everything" has '
        f"{base.hidden} hidden units where the link moves and {base.still_hidden} where it stands still. Made by",
        "",
        f"`python -m agents.ablation --steps {steps} --seeds {seeds}{chosen}`",
        "",
        *variants_table(measured, sizes, base.suites),
        "",
    ]
    if runs:
        folders = [Path(run) for run in runs.split(",")]
        about = (
            "The best regret over AFR's on validation so far, a mean over the suites. A run ends where it was stopped."
        )
        lines += ["## How they learned", "", about, "", *learning(folders), "", "## What more seeds are worth", ""]
        for folder in folders:
            settings = read_settings(folder)
            if settings["algo"] == "evolution" and settings["seeds"] > 2:
                lines += [*more_seeds(folder), ""]
    publish("\n".join(lines), out)


if __name__ == "__main__":
    command(main)

"""The gain of trained agents over AFR: all training seeds of a run on the test splits of suites, as a page.

``python -m agents.goals runs/NAME --suites lte-v1,outage-v1 --out docs/agents.md`` (``--data DIR`` for recordings).

The figure is the regret over AFR's: the sum of an agent's regrets over the cells (scenario, L) of one L, or over all,
divided by AFR's. Intervals are percentile bootstraps: first training seeds are drawn, then the episodes of each cell,
the same ones for the agent and for AFR.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agents.evaluation import EvaluationSet, Numbers
from agents.page import columns_of, command, publish, table, written
from agents.runs import MODEL, read_settings
from bufgym import policies
from bufgym.benchmark.bootstrap import Interval
from bufgym.benchmark.score import regret, scores
from bufgym.benchmark.sweep import Sweep
from bufgym.ground import files
from bufgym.ground.errors import BufgymError
from bufgym.oracle import BASELINE, EveryLength, law, online_optimum
from bufgym.policies import Policy, registry
from bufgym.scenario import Interruption
from bufgym.scenario.suites import get as suite_of

RESAMPLES = 500
RESAMPLES_OF_MANY = 200
"""Resamples with more than ``MANY`` cells, whose mean varies less."""
MANY = 30
AFR = "afr"
AGENTS = "agents"
NEGLIGIBLE = 1e-9
"""Sum of AFR's regrets below which a ratio says nothing."""


@dataclass(frozen=True)
class SuiteResults:
    """H of every policy in every cell of one suite, episode by episode."""

    suite: str
    """Its name."""
    cells: list[tuple[str, int]]
    """(scenario, L)"""
    best: list[Numbers]
    """The clairvoyant's H, float64[episodes] of each cell."""
    fixed: dict[str, list[Numbers]]
    """H of each fixed policy, likewise."""
    agents: list[list[Numbers]]
    """H of each training seed, likewise."""
    scores: dict[str, Interval]
    """Scores of the agents together (AGENTS) and of every fixed policy: 0 is Drop Oldest, 1 the clairvoyant."""

    def ratio(self, seeds_qoi: Sequence[list[Numbers]], cells: Sequence[int], rng: np.random.Generator) -> Interval:
        """Regret over AFR's in these cells; ``seeds_qoi`` has H by training seed, as ``agents``."""

        def resampled(seeds: Sequence[int], picks: Sequence[NDArray[np.int64] | slice]) -> float:
            agents = afr = 0.0
            for cell, pick in zip(cells, picks, strict=True):
                best = self.best[cell][pick].sum()
                agents += float(np.mean([float(regret(seeds_qoi[s][cell][pick].sum(), best)) for s in seeds]))
                afr += float(regret(self.fixed[AFR][cell][pick].sum(), best))
            return agents / afr if afr > NEGLIGIBLE else float("nan")

        count = len(seeds_qoi)
        ratios = []
        for _ in range(RESAMPLES_OF_MANY if len(cells) > MANY else RESAMPLES):
            picks = [rng.integers(len(self.best[cell]), size=len(self.best[cell])) for cell in cells]
            ratios.append(resampled(rng.integers(count, size=count).tolist(), picks))
        low, high = np.nanpercentile(ratios, [2.5, 97.5])
        return Interval(resampled(range(count), [slice(None)] * len(cells)), float(low), float(high))

    def behind(self, rival: str, rng: np.random.Generator) -> list[str]:
        """Cells where the agents' mean H lies below the rival's by more than its interval."""
        lines = []
        for cell, (label, L) in enumerate(self.cells):
            gain = np.array([agent[cell] for agent in self.agents]) - self.fixed[rival][cell]
            seeds, episodes = gain.shape
            means = [
                gain[rng.integers(seeds, size=seeds)][:, rng.integers(episodes, size=episodes)].mean()
                for _ in range(RESAMPLES)
            ]
            if np.percentile(means, 97.5) < 0:
                share = -gain.mean() / self.best[cell].mean()
                lines.append(f"- {label}, L = {L}: H is below {rival}'s by {share:.2%} of the clairvoyant's")
        return lines


def measure(
    suite: str, agents: Sequence[Policy], folder: Path, data: str | None, seeds: int | None = None
) -> SuiteResults:
    """Agents and ranked fixed policies on the suite's test split; the fixed policies' rows are kept in ``folder``."""
    shipped = files.shipped("agents", "agents/pretrained", "*.safetensors")
    fixed = [name for name in registry.names(for_topics=False) if name not in shipped]
    ranked = [name for name in fixed if registry.get(name).ranked]
    sweep = Sweep(suite, tuple(ranked), "test", suite_of(suite).capacities, seeds, data)
    evaluation = EvaluationSet(sweep, folder / "goals" / suite)
    cells = [(cell.label, cell.capacity) for cell in evaluation.cells]
    rows = [evaluation.benchmark_rows(evaluation.run(agent), AGENTS, seed) for seed, agent in enumerate(agents)]
    result = scores([{**row, "training_seed": None} for row in evaluation.rows] + [row for own in rows for row in own])
    indices = [[i for i, row in enumerate(rows[0]) if (row["scenario"], row["capacity"]) == cell] for cell in cells]

    def split(numbers: Numbers) -> list[Numbers]:
        return [numbers[own] for own in indices]

    return SuiteResults(
        suite,
        cells,
        split(evaluation.fixed(AFR, "clairvoyant")),
        {name: split(evaluation.fixed(name)) for name in ranked},
        [split(np.array([row["qoi"] for row in own], np.float64)) for own in rows],
        {standing.policy: standing["score"] for standing in result.standings},
    )


# --- the page --------------------------------------------------------------------------------------------------------


def section(results: SuiteResults) -> list[str]:
    """Markdown of one suite."""
    rng = np.random.default_rng(0)
    every = list(range(len(results.cells)))
    fixed = {name: results.ratio([h], every, rng).value for name, h in results.fixed.items() if name != AFR}
    best = min(fixed, key=lambda name: fixed[name])
    groups = {str(L): [i for i in every if results.cells[i][1] == L] for L in sorted({L for _, L in results.cells})}
    rows = []
    for name, cells in [*groups.items(), ("all", every)]:
        seeds = [f"{results.ratio([agent], cells, rng).value:.2f}" for agent in results.agents]
        rival = results.ratio([results.fixed[best]], cells, rng).value
        rows.append([name, written(results.ratio(results.agents, cells, rng), ".2f"), *seeds, f"{rival:.2f}"])
    head = ["L", "all seeds", *(f"seed {s}" for s in range(len(results.agents))), best]
    scenarios = []
    for label in dict.fromkeys(label for label, _ in results.cells):
        cells = [i for i in every if results.cells[i][0] == label]
        scenarios.append(f"{label} {results.ratio(results.agents, cells, rng).value:.2f}")
    shown = ", ".join(f"{name} {written(results.scores[name], '.3f')}" for name in (AGENTS, best, AFR))
    rivals = dict.fromkeys([AFR, BASELINE, best])
    behind = [line for rival in rivals for line in results.behind(rival, rng)]
    below = f"the agents' mean H is below {' or '.join(rivals)} by more than the interval"
    return [
        *(f"## {results.suite}", "", *table(head, rows), "", f"The ratio by scenario is: {', '.join(scenarios)}.", ""),
        *(f"The scores are: {shown}. The score of {BASELINE} is 0 and the clairvoyant's is 1.", ""),
        *([f"In these cells {below}:"] if behind else [f"In no cell {below}."]),
        *("", *behind, ""),
    ]


SMALL = ((1, 400), (2, 300), (3, 120), (4, 70))
"""L, and the longest T for which the online optimum's table fits."""


def optimum(agents: Sequence[Policy]) -> list[str]:
    """Markdown: the agents, AFR and the exact optimum of a sender that does not know T, at small L."""
    rows = []
    for label, setting in suite_of("interruption-v1").settings("test").items():
        for L, t_max in SMALL:
            scenario = Interruption(t_max=t_max, value=setting.scenario.value)
            lengths = EveryLength(scenario, [L])
            solved = online_optimum(L, law(scenario), scenario.value, objective="qoi").policy()
            best, afr = lengths.regrets(solved)[0], lengths.regrets(policies.get(AFR))[0]
            mean = float(np.mean([lengths.regrets(agent)[0] for agent in agents]))
            excess = (mean - best) / (afr - best)
            rows.append([label, L, t_max, f"{afr:.2%}", f"{best:.2%}", f"{mean:.2%}", f"{excess:.0%}"])
    return [
        "## Against the online optimum",
        "",
        "T is log-uniform on 1..t_max. The excess is a mean over the seeds:",
        "",
        "    excess = (agent's regret - optimum's regret) / (AFR's regret - optimum's regret)",
        "",
        *table(["V", "L", "t_max", "AFR's regret", "optimum's", "agents'", "excess"], rows),
        "",
    ]


def exact(agents: Sequence[Policy]) -> list[str]:
    """Markdown: regret over AFR's on interruption-v1, exact over the test split's lengths, cell by cell."""
    suite = suite_of("interruption-v1")
    rows = []
    for label, setting in suite.settings("test").items():
        lengths = EveryLength(setting.scenario, suite.capacities)
        afr = np.array(lengths.regrets(policies.get(AFR)))
        ratios = np.array([lengths.regrets(agent) for agent in agents]) / afr
        rows.append([label, *(f"{np.mean(own):.2f} ({min(own):.2f}-{max(own):.2f})" for own in ratios.T)])
    return [
        "## interruption-v1, exactly",
        "",
        "The figure is the regret over AFR's. It is exact over the law of the test split's T, as one run holds all "
        "lengths. The mean over the seeds comes first, then their range.",
        "",
        *table(["V", *(f"L = {L}" for L in suite.capacities)], rows),
        "",
    ]


def main(
    run: Path,
    suites: str = "interruption-v1,lte-v1,outage-v1,sustained-v1",
    data: str | None = None,
    seeds: int | None = None,
    out: Path | None = None,
) -> None:
    """The gain of a run's agents over AFR, as a page.

    Args:
        run: folder of a run of train.py --algo evolution.
        suites: suites to test on.
        data: folder of recordings.
        seeds: episodes a trace, if not the suite's own.
        out: Markdown file to write; the page is printed in any case.
    """
    models = sorted(run.glob(f"seed-*/{MODEL}"))
    if not models:
        raise BufgymError(f"{run}: no seed-*/{MODEL}; a run of train.py --algo evolution has them")
    agents = [policies.load(model) for model in models]
    lines = [f"# {run.name}: {len(agents)} training seeds", ""]
    if (run / "settings.json").exists():
        steps = [max(row[0] for row in columns_of(model.parent / "curve.csv", "steps")) / 1e6 for model in models]
        decisions = ", ".join(f"{million:.0f} M" for million in steps)
        lines += [f"Made by `{read_settings(run)['command']}`. The seeds stopped after {decisions} decisions.", ""]
    folder = " --data DIR" if data else ""
    lines += [f"This page is made by `python -m agents.goals runs/{run.name} --suites {suites}{folder}`.", ""]
    lines += ["The figure is the regret over AFR's. Its 95 % interval is over training seeds and episodes.", ""]
    for suite in suites.split(","):
        lines += section(measure(suite, agents, run, data, seeds))
        if suite == "interruption-v1":
            lines += exact(agents) + optimum(agents)
    publish("\n".join(lines), out)


if __name__ == "__main__":
    command(main)

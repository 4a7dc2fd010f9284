"""The gain of trained agents over AFR: all training seeds of a run on the test splits of suites, as a page.

``python -m agents.goals runs/NAME --suites lte-v1,outage-v1 --out docs/agents.md`` (``--data DIR`` for recordings).

The figure is the share of AFR's regret over the discriminative cells (scenario, L) of one L, or over all of them: a
ratio of sums, see ``bufgym.benchmark.score``. So are the intervals: training seeds are drawn, and links, one draw for
all cells, the agents and AFR.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation import EvaluationSet
from agents.page import columns_of, command, publish, table, written
from agents.runs import MODEL, read_settings
from bufgym import policies
from bufgym.benchmark import episodes
from bufgym.benchmark.bootstrap import (
    RESAMPLES,
    SEED,
    Interval,
    links_drawn,
    percentile_interval,
    stream,
    times_drawn,
)
from bufgym.benchmark.rows import Row
from bufgym.benchmark.score import Scores, scores
from bufgym.benchmark.sweep import Sweep
from bufgym.benchmark.table import decimal
from bufgym.ground import files
from bufgym.ground.errors import BufgymError
from bufgym.oracle import BASELINE, EveryLength, law, online_optimum
from bufgym.policies import Policy, registry
from bufgym.scenario import Interruption
from bufgym.scenario.suites import get as suite_of

AFR = "afr"
AGENTS = "agents"


@dataclass(frozen=True)
class SuiteResults:
    """Rows of one suite's test split."""

    suite: str
    """Its name."""
    rows: list[Row]
    """Of every ranked fixed policy, of all agents as the training seeds of one policy AGENTS, and of each agent alone
    as the policies ``seeds``."""
    seeds: list[str]
    """A name for each agent."""
    scores: Scores
    """Of all rows."""

    def shares(self, names: Collection[str], **where: Any) -> dict[str, Interval]:
        """The share of AFR's regret of these policies in the cells whose "scenario" or "capacity" is as given."""
        names = {*names, AFR, BASELINE}
        rows = [row for row in self.rows if row["policy"] in names and where.items() <= row.items()]
        return {standing.policy: standing["share"] for standing in scores(rows).standings}

    def behind(self, rival: str) -> list[str]:
        """Cells where the agents' mean H lies below the rival's by more than its interval."""
        table = episodes.read([row for row in self.rows if row["policy"] in (AGENTS, rival, BASELINE)], BASELINE)
        drawn, trained = links_drawn(table.episodes), len(self.seeds)
        seeds = times_drawn(trained, RESAMPLES, stream(SEED, f"training of {AGENTS}")) / trained
        lines = []
        for label, L in table.cells:
            gain, weights = table.qoi[AGENTS, (label, L)] - table.qoi[rival, (label, L)], drawn[label]
            if percentile_interval((weights * (seeds @ gain)).sum(axis=1) / weights.sum(axis=1)).high < 0:
                share = -gain.mean() / table.best[label, L].mean()
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
    rows: list[Row] = [{**row, "training_seed": None} for row in evaluation.rows]
    names = [f"seed {seed}" for seed in range(len(agents))]
    for seed, agent in enumerate(agents):
        own = evaluation.benchmark_rows(evaluation.run(agent), AGENTS, seed)
        rows += [*own, *({**row, "policy": names[seed]} for row in own)]
    return SuiteResults(suite, rows, names, scores(rows))


# --- the page --------------------------------------------------------------------------------------------------------


def section(results: SuiteResults) -> list[str]:
    """Markdown of one suite."""
    standings = {standing.policy: standing for standing in results.scores.standings}
    fixed = {name: one["share"].value for name, one in standings.items() if name not in (AFR, AGENTS, *results.seeds)}
    best = min(fixed, key=lambda name: (math.isnan(fixed[name]), fixed[name]))
    columns = [AGENTS, *results.seeds, best]
    cells = dict.fromkeys((cell.scenario, cell.capacity) for cell in results.scores.cells)
    groups = {str(L): results.shares(columns, capacity=L) for L in sorted({L for _, L in cells})}
    counted = f"all, {results.scores.counted} of {len(cells)} cells"
    groups[counted] = {name: standings[name]["share"] for name in columns}
    rows = []
    for name, found in groups.items():
        alone = [decimal(found[column].value, 2) for column in columns[1:]]
        rows.append([name, written(found[AGENTS], ".2f"), *alone])
    labels = dict.fromkeys(label for label, _ in cells)
    scenarios = [f"{label} {written(results.shares([AGENTS], scenario=label)[AGENTS], '.2f')}" for label in labels]
    shown = ", ".join(f"{name} {written(standings[name]['score'], '.3f')}" for name in (AGENTS, best, AFR))
    rivals = dict.fromkeys([AFR, BASELINE, best])
    behind = [line for rival in rivals for line in results.behind(rival)]
    below = f"the agents' mean H is below {' or '.join(rivals)} by more than the interval"
    return [
        *(f"## {results.suite}", "", *table(["L", "all seeds", *columns[1:]], rows), ""),
        *(f"The share by scenario is: {', '.join(scenarios)}.", ""),
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
        "The figure is the regret over AFR's in this cell. It is exact over the law of the test split's T, as one "
        "run holds all lengths. The mean over the seeds comes first, then their range.",
        "",
        *table(["V", *(f"L = {L}" for L in suite.capacities)], rows),
        "",
    ]


FIGURE = (
    "The figure is the share of AFR's regret: the sum of the regrets over the cells (scenario, L), divided by the sum "
    "of AFR's, a ratio of sums. Cells where Drop Oldest's regret is under 1 % do not count. The 95 % interval is over "
    "training seeds and links, which are drawn jointly for all cells."
)


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
    lines += [FIGURE, ""]
    for suite in suites.split(","):
        lines += section(measure(suite, agents, run, data, seeds))
        if suite == "interruption-v1":
            lines += exact(agents) + optimum(agents)
    publish("\n".join(lines), out)


if __name__ == "__main__":
    command(main)

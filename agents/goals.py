"""How far trained agents are above AFR: all training seeds of a run on the test splits of suites, as a page.

``python -m agents.goals runs/NAME --suites lte-v1,outage-v1 --out docs/agents.md`` (``--data DIR`` for recordings).

The figure is the regret over AFR's: the sum of an agent's regrets over the cells (scenario, L) of one L, or over all,
divided by that of AFR's. Intervals are percentile bootstraps: training seeds are drawn, then the episodes of each cell,
the same ones for the agent and for AFR.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agents.export import command
from agents.grounds import Lengths
from agents.trials import Trials
from agents.worlds import Cell
from bufgym import files, policies
from bufgym.benchmark.score import BASELINE, Interval, regret, scores
from bufgym.benchmark.sweep import Plan
from bufgym.errors import BufgymError
from bufgym.oracle import law, online_optimum
from bufgym.policies import Policy, registry
from bufgym.scenario import Interruption, suites

Numbers = NDArray[np.float64]

RESAMPLES = 2000
AFR = "afr"
AGENTS = "agents"
NOTHING = 1e-9
"""Where AFR's regrets add up to less, a ratio says nothing."""


@dataclass(frozen=True)
class Span:
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"


@dataclass(frozen=True)
class Found:
    """One suite: H of every policy in every cell, episode by episode."""

    suite: str
    cells: list[tuple[str, int]]
    """(scenario, L)"""
    best: list[Numbers]
    """[episodes] of each cell: the clairvoyant's."""
    fixed: dict[str, list[Numbers]]
    agents: list[list[Numbers]]
    """By training seed, then as ``fixed``."""
    scores: dict[str, Interval]
    """Of the agents together (AGENTS) and of every fixed policy: 0 is Drop Oldest, 1 the clairvoyant."""

    def ratio(self, given: Sequence[list[Numbers]], cells: Sequence[int], rng: np.random.Generator) -> Span:
        """Regret over AFR's in these cells; ``given``: one entry a training seed."""
        afr = self.fixed[AFR]

        def once(seeds: Sequence[int], picks: Sequence[NDArray[np.int64] | slice]) -> float:
            mine = theirs = 0.0
            for cell, pick in zip(cells, picks, strict=True):
                best = self.best[cell][pick].sum()
                mine += float(np.mean([float(regret(given[s][cell][pick].sum(), best)) for s in seeds]))
                theirs += float(regret(afr[cell][pick].sum(), best))
            return mine / theirs if theirs > NOTHING else float("nan")

        every = range(len(given))
        drawn = []
        for _ in range(RESAMPLES // 10 if len(cells) > 30 else RESAMPLES // 4):
            picks = [rng.integers(len(self.best[cell]), size=len(self.best[cell])) for cell in cells]
            drawn.append(once(rng.integers(len(given), size=len(given)).tolist(), picks))
        low, high = np.nanpercentile(drawn, [2.5, 97.5])
        return Span(once(list(every), [slice(None)] * len(cells)), float(low), float(high))

    def capacity(self, L: int) -> list[int]:
        """The cells of this L."""
        return [i for i, (_, capacity) in enumerate(self.cells) if capacity == L]

    def behind(self, rival: str, rng: np.random.Generator) -> list[str]:
        """Cells where the agents' mean H lies below the rival's by more than its interval."""
        found = []
        for cell, (label, L) in enumerate(self.cells):
            gain = np.array([agent[cell] for agent in self.agents]) - self.fixed[rival][cell]
            seeds, episodes = gain.shape
            means = [
                gain[rng.integers(seeds, size=seeds)][:, rng.integers(episodes, size=episodes)].mean()
                for _ in range(RESAMPLES // 4)
            ]
            if np.percentile(means, 97.5) < 0:
                share = -gain.mean() / self.best[cell].mean()
                found.append(f"{label}, L = {L}: H {share:.2%} of the clairvoyant's below {rival}")
        return found


def measure(suite: str, agents: Sequence[Policy], folder: Path, data: str | None, seeds: int | None = None) -> Found:
    """Agents and ranked fixed policies on the suite's test split; what is fixed is kept in ``folder``."""
    shipped = files.shipped("agents", "agents/pretrained", "*.safetensors")
    fixed = [name for name in registry.names(for_topics=False) if name not in shipped]
    ranked = [name for name in fixed if registry.get(name).ranked]
    trials = Trials(
        Plan(suite, tuple(ranked), "test", suites.get(suite).capacities, seeds, data), folder / "goals" / suite
    )
    keys = [(cell.label, cell.capacity) for cell in trials.cells]
    own = [trials.rows_under(agent, AGENTS, seed) for seed, agent in enumerate(agents)]
    found = scores([{**row, "training_seed": None} for row in trials.rows] + [row for rows in own for row in rows])
    at = [[i for i, row in enumerate(own[0]) if (row["scenario"], row["capacity"]) == key] for key in keys]

    def split(numbers: Numbers) -> list[Numbers]:
        return [numbers[rows] for rows in at]

    return Found(
        suite,
        keys,
        split(trials.known(AFR, "clairvoyant")),
        {name: split(trials.known(name)) for name in ranked},
        [split(np.array([row["qoi"] for row in rows], np.float64)) for rows in own],
        {standing.policy: standing.score for standing in found.standings},
    )


# --- the page --------------------------------------------------------------------------------------------------------


def section(found: Found) -> list[str]:
    """Markdown of one suite."""
    rng = np.random.default_rng(0)
    every = range(len(found.cells))
    fixed = {name: found.ratio([h], list(every), rng).value for name, h in found.fixed.items() if name != AFR}
    best = min(fixed, key=lambda name: fixed[name])
    seeds = " | ".join(f"seed {s}" for s in range(len(found.agents)))
    lines = [f"## {found.suite}", "", f"| L | all seeds | {seeds} | {best} |", "|---" * (len(found.agents) + 3) + "|"]
    capacities = sorted({L for _, L in found.cells})
    for name, cells in [(str(L), found.capacity(L)) for L in capacities] + [("all", list(every))]:
        each = " | ".join(f"{found.ratio([agent], cells, rng).value:.2f}" for agent in found.agents)
        rival = found.ratio([found.fixed[best]], cells, rng).value
        lines.append(f"| {name} | {found.ratio(found.agents, cells, rng)} | {each} | {rival:.2f} |")
    labels = list(dict.fromkeys(label for label, _ in found.cells))
    parts = [(label, [i for i in every if found.cells[i][0] == label]) for label in labels]
    told = ", ".join(f"{label} {found.ratio(found.agents, cells, rng).value:.2f}" for label, cells in parts)
    lines += ["", f"By scenario: {told}.", ""]
    shown = ", ".join(f"{name} {_score(found.scores[name])}" for name in (AGENTS, best, AFR))
    lines += [f"Scores (0 is {BASELINE}, 1 the clairvoyant): {shown}.", ""]
    rivals = dict.fromkeys([AFR, BASELINE, best])
    behind = [line for rival in rivals for line in found.behind(rival, rng)]
    told = ", ".join(rivals)
    lines.append(f"Below {told} by more than the interval: {'nowhere.' if not behind else ''}")
    return [*lines, "", *(f"- {line}" for line in behind), ""]


def _score(score: Interval) -> str:
    return f"{score.value:.3f} [{score.low:.3f}, {score.high:.3f}]"


SMALL = ((1, 400), (2, 300), (3, 120), (4, 70))
"""L, and the longest T for which the online optimum's table fits."""


def optimum(agents: Sequence[Policy]) -> list[str]:
    """Markdown: the agents, AFR and the exact optimum of a sender that does not know T, at small L."""
    lines = [
        "## Against the online optimum",
        "",
        "T log-uniform on 1..t_max. Excess: (agent's regret - optimum's) / (AFR's - optimum's), mean over the seeds.",
        "",
        "| V | L | t_max | AFR's regret | optimum's | agents' | excess |",
        "|---|---|---|---|---|---|---|",
    ]
    for label, setting in suites.get("interruption-v1").settings("test").items():
        for L, t_max in SMALL:
            scenario = Interruption(t_max=t_max, value=setting.scenario.value)
            ground = Lengths(Cell(label, scenario, L))
            solved = online_optimum(L, law(scenario), scenario.value, objective="qoi").policy()
            best, afr = ground.regret(solved), ground.regret(policies.get(AFR))
            mine = float(np.mean([ground.regret(agent) for agent in agents]))
            excess = (mine - best) / (afr - best)
            lines.append(f"| {label} | {L} | {t_max} | {afr:.2%} | {best:.2%} | {mine:.2%} | {excess:.0%} |")
    return [*lines, ""]


def exact(agents: Sequence[Policy]) -> list[str]:
    """Markdown: regret over AFR's on interruption-v1, exact over the test split's lengths, cell by cell."""
    settings = suites.get("interruption-v1").settings("test")
    capacities = suites.get("interruption-v1").capacities
    lines = [
        "## interruption-v1, exactly",
        "",
        "Regret over AFR's, exact over the law of the test split's T (one run holds all lengths); mean, then the seeds'"
        " range.",
        "",
        "| V | " + " | ".join(f"L = {L}" for L in capacities) + " |",
        "|---" * (len(capacities) + 1) + "|",
    ]
    for label, setting in settings.items():
        shown = []
        for L in capacities:
            ground = Lengths(Cell(label, setting.scenario, L))
            afr = ground.regret(policies.get(AFR))
            found = [ground.regret(agent) / afr for agent in agents]
            shown.append(f"{np.mean(found):.2f} ({min(found):.2f}-{max(found):.2f})")
        lines.append(f"| {label} | " + " | ".join(shown) + " |")
    return [*lines, ""]


def reached(files: Sequence[Path]) -> list[str]:
    """Decisions that each of these seeds learned from."""
    found = []
    for file in files:
        with (file.parent / "curve.csv").open(newline="", encoding="utf-8") as rows:
            found.append(f"{max(int(row['steps']) for row in csv.DictReader(rows)) / 1e6:.0f} M")
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m agents.goals", description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a run of train.py --algo evolution")
    parser.add_argument("--suites", default="interruption-v1,lte-v1,outage-v1,sustained-v1")
    parser.add_argument("--data", default=None, help="folder of recordings")
    parser.add_argument("--seeds", type=int, default=None, help="episodes a trace, if not the suite's own")
    parser.add_argument("--out", type=Path, default=None, help="Markdown file to write; printed otherwise")
    options = parser.parse_args(arguments)
    try:
        files = sorted(options.run.glob("seed-*/model.safetensors"))
        if not files:
            raise BufgymError(
                f"{options.run}: no seed-*/model.safetensors; a run of train.py --algo evolution has them"
            )
        agents = [policies.load(file) for file in files]
        lines = [f"# {options.run.name}: {len(agents)} training seeds", ""]
        noted = options.run / "settings.json"
        if noted.exists():
            given = json.loads(noted.read_text(encoding="utf-8"))
            lines += [f"Made by `{command(given)}`; seeds stopped after {', '.join(reached(files))} decisions.", ""]
        data = " --data DIR" if options.data else ""
        lines += [f"This page: `python -m agents.goals runs/{options.run.name} --suites {options.suites}{data}`.", ""]
        lines += ["The figure is the regret over AFR's, with its 95 % interval over training seeds and episodes.", ""]
        for suite in options.suites.split(","):
            found = measure(suite, agents, options.run, options.data, options.seeds)
            lines += section(found)
            if suite == "interruption-v1":
                lines += exact(agents) + optimum(agents)
        text = "\n".join(lines)
        if options.out:
            options.out.write_text(text, encoding="utf-8")
        print(text)
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()

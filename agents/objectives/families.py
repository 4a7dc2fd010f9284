"""Families of links side by side: the less of AFR's regret is left, the better, as a mean over the families."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

from agents.constants import UNTAUGHT
from agents.families import Family
from agents.objectives.objective import Objective
from agents.ready_families import runs_of
from agents.report import Report, Trained, agent_name
from agents.settings import Hindsight, Settings
from bufgym import policies
from bufgym.benchmark.bootstrap import Interval, written
from bufgym.policies import Policy
from bufgym.utils.tables import aligned

RIVALS = ("target-gap", "gap-price", "learned")
TEST_RUNS = 96
"""Test runs of each family."""


@functools.lru_cache(maxsize=2)
def _families(names: tuple[str, ...], split: str, runs: int, data: str | None) -> list[Family]:
    """Some runs of each family, with bounds that take seconds."""
    return [Family(name, runs_of(name, split, runs, data)) for name in names]


class FamiliesObjective(Objective):
    """The families of a run."""

    best = min

    def __init__(self, settings: Settings, folder: Path, seed: int) -> None:
        super().__init__(settings, folder, seed)
        assert isinstance(settings, Hindsight)
        self.names, self.data = settings.sets.named(settings.suites.data), settings.suites.data
        self.columns = (*self.names, "mean")
        self.message = f"{{{len(self.names)}:.3f}} of AFR's regret on validation"

    @functools.cached_property
    def judges(self) -> list[Family]:
        """The validation runs of each family."""
        return _families(self.names, "validation", -(-self.settings.validations() // len(self.names)), self.data)

    def validate(self, agent: Policy) -> tuple[float, ...]:
        """The share of AFR's regret on each family, and their mean."""
        shares = [family.share(agent) for family in self.judges]
        return (*shares, sum(shares) / len(shares))

    def report(self, trained: Trained) -> Report:
        """A table of every seed's agent beside rules on the test runs of each family."""
        kept = zip(trained.runs, trained.agents, strict=True)
        agents = [replace(agent, name=agent_name(run)) for run, agent in kept if isinstance(agent, Policy)]
        rivals = [*UNTAUGHT, *(policies.get(name) for name in RIVALS)]
        lines = [["family", "runs", *(p.name for p in (*agents, *rivals)), *(f"best - {n} [95 %]" for n in RIVALS)]]
        chosen = [run.seed for run in trained.runs].index(trained.best.seed)
        for family in _families(self.names, "test", TEST_RUNS, self.data):
            found = family.against([*agents, *rivals])
            shares = [f"{share:.3f}" for share, _ in found]
            behind = [_text(interval) for interval in found[chosen][1][-len(RIVALS) :]]
            lines.append([family.name, str(len(family.best)), *shares, *behind])
        text = "\n".join([*aligned(lines), "shares of AFR's regret: 0 is the clairvoyant, 1 AFR"])
        (trained.folder / "results.txt").write_text(text + "\n", encoding="utf-8")
        print(text)
        return trained.seeds, {}, f"best on validation: seed {trained.best.seed}; model and results.txt"


def _text(interval: Interval) -> str:
    """Three digits, with a sign."""
    return " ".join(filter(None, written(interval, lambda number: format(number, "+.3f"))))

"""Robots that share a cell: each policy runs on all robots and is compared with AFR robot by robot."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from bufgym.benchmark.bootstrap import NOT_NEGATIVE, SHARES, ratio
from bufgym.benchmark.episodes import Numbers
from bufgym.benchmark.rows import Layout, Row, columns_of
from bufgym.benchmark.summary import Quantity, Run, Summary, by_run, summarise
from bufgym.benchmark.table import NOBODY, Unranked, decimal, percent, score, signed
from bufgym.benchmark.tasks.task import Result, Task, counted
from bufgym.oracle.measure import TIE
from bufgym.policies import Policy, get, names
from bufgym.scenario import FleetEpisode, FleetScenario
from bufgym.sim.cell import run_fleet
from bufgym.sim.metrics import Outcome, outcome
from bufgym.utils.errors import BufgymError

ROWS: Layout = {
    **{"scenario": str, "trace": str, "seed": int, "robots": int, "policy": str, "capacity": int, "robot": int},
    **columns_of(Outcome),
}
"""One row for each robot and episode: the robot's number, the fleet's size and the robot's ``Outcome``."""


@dataclass(frozen=True)
class FleetTask(Task):
    """Robots that share one uplink, the same policy on each.

    Robots are not independent, so intervals resample links, never robots.
    """

    kind = "fleet"
    scenarios = (FleetScenario,)
    layout = ROWS
    needed = tuple(ROWS)
    baseline = "afr"
    reference = "afr"
    listed = ("gain", "above", "worst")
    no_plan = "a link of its own, which no robot in a cell has"
    legend = (
        "Team QoI: mean of H over the robots. Intervals: 95 %, resampling links, as the robots of one share it.",
        "Robots above, below: with a larger or smaller H than the same robot under AFR. Fairness: Jain's index of H.",
    )

    def default_policies(self) -> list[str]:
        """The ranked policies for one queue."""
        return [name for name in names(for_topics=False) if get(name).ranked]

    def messages(self, scenario: FleetScenario) -> int:
        return scenario.max_messages * scenario.robots

    def rows_per_run(self, scenario: FleetScenario) -> int:
        return scenario.robots

    def play(
        self, policies: Sequence[Policy], scenario: FleetScenario, episodes: Sequence[FleetEpisode], capacity: int
    ) -> Iterator[list[Result]]:
        for policy in policies:
            fleet = run_fleet(policy, episodes, capacity, scenario.value)
            yield [
                [
                    {"robots": scenario.robots, "robot": robot, **asdict(outcome(fleet.senders, i))}
                    for robot, i in enumerate(fleet.rows(c))
                ]
                for c in range(len(episodes))
            ]

    def quantities(self) -> tuple[Quantity, ...]:
        afr = self.baseline
        same = f"the same robot's H under {afr}"
        above = f"robots whose H is above {same}"
        below = f"robots whose H is below {same}. The rest are equal"
        jain = "Jain's index of the robots' H, (sum H)^2 / (N sum H^2): 1 if all are equal, 1/N if one has everything"
        return (
            Quantity(
                *("team", "team QoI", score, "mean over the robots of H, mean over episodes"),
                interval=False,
                within=NOT_NEGATIVE,
            ),
            Quantity("gain", f"gain over {afr}", signed, f"team QoI minus {afr}'s team QoI", versus=afr, drawn=True),
            Quantity("above", f"robots above {afr}'s", percent, above, versus=afr, drawn=True, within=SHARES),
            Quantity("below", "below", percent, below, interval=False, versus=afr, within=SHARES),
            Quantity(
                "worst",
                "worst robot",
                score,
                "the least H of a robot, mean over episodes",
                interval=False,
                within=NOT_NEGATIVE,
            ),
            Quantity(
                *("fairness", "fairness", partial(decimal, digits=4), f"{jain} (Jain, Chiu and Hawe 1984)"),
                interval=False,
                within=SHARES,
            ),
        )

    def summary(self, rows: Sequence[Row], unranked: Unranked = NOBODY, against: str = "") -> Summary:
        options: Any = {"rank_by": "gain", "baseline": self.baseline, "unranked": unranked, "against": against}
        return summarise(_runs(rows), _statistics, self.quantities(), **options)

    def describe(self, scenarios: Sequence[FleetScenario], episodes: int) -> str:
        fleet = scenarios[0]
        links = counted(len({trace.name for fleet in scenarios for trace in fleet.uplink.traces}), "link")
        many, robots = counted(episodes, "episode"), counted(fleet.robots, "robot")
        return f"{many} of {fleet.uplink.duration_s:g} s on {links}, {robots} in a cell."


def _runs(rows: Sequence[Row]) -> dict[Run, list[float]]:
    """H of each robot by run."""
    robots: dict[str, set[int]] = {}
    runs = by_run(rows, "robot", "qoi")
    for (scenario, capacity, policy, trace, seed), run in runs.items():
        if odd := sorted(robots.setdefault(scenario, set(run)) ^ run.keys()):
            place = f"{policy} at {scenario}, L = {capacity}, trace {trace}, seed {seed}"
            raise BufgymError(f"{place}: robot {odd[0]} is not in every episode; all must have the same robots")
    return {key: [run[robot]["qoi"] for robot in sorted(run)] for key, run in runs.items()}


def _statistics(ours: Numbers, base: Numbers, weights: Numbers) -> dict[str, Numbers]:
    """See ``summary.Statistics``; H[episodes, robots]."""
    square = ours.shape[1] * np.square(ours).sum(1)
    by_episode = {
        "team": ours.mean(1),
        "gain": (ours - base).mean(1),
        "above": (ours - base > TIE * base).mean(1),
        "below": (base - ours > TIE * base).mean(1),
        "worst": ours.min(1),
        # If no robot got anything, all are equal.
        "fairness": np.where(square > 0, ratio(np.square(ours.sum(1)), square, square > 0), 1.0),
    }
    return {name: weights @ numbers / weights.sum(1) for name, numbers in by_episode.items()}

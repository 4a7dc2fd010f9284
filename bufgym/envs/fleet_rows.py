"""The rows that both fleet environments are made of: every robot of every cell, and one compiled step over all of them.

They are the rows of the other environments (what is shown, masked and earned is computed by the same kernels); only
their links are shared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from bufgym.envs.rows import Rows, Shown, decision_of, show, write_rewards
from bufgym.errors import BufgymError
from bufgym.kernel import kernel
from bufgym.model.link import FOREVER
from bufgym.scenario import FleetScenario, Streams
from bufgym.sim import DECISION, DEPARTURE, END, Batch, credit, decide, next_event, offer
from bufgym.sim.cell import Fleet
from bufgym.sim.shared_link import Shares, next_in_cell

REWARDS = ("team", "own")
"""Whose information a robot is paid for: the mean over its cell, or its own."""


@kernel
def advance_cell(batch: Batch, shares: Shares, c: int) -> None:
    """On to the next tick, where every robot of cell ``c`` has a decision due, or to the end."""
    robots = shares.cells[c].robots
    event = next_event(batch, shares, c)
    while event == DEPARTURE:
        event = next_event(batch, shares, c)
    if event == DECISION:
        for _ in range(1, robots):
            next_in_cell(batch, shares, c)
    for i in range(c * robots, (c + 1) * robots):
        sender = batch.senders[i]
        if event == END:
            credit(batch, i, FOREVER)
            # What a dead link never carried was not retained after all.
            sender.retained_gain = sender.delivered_gain
        else:
            credit(batch, i, sender.now_us)


@kernel
def begin_cells(
    batch: Batch, shares: Shares, cells: NDArray[np.int64], rewarded: NDArray[np.float64], shown: Shown
) -> None:
    """Bring freshly loaded cells to their first tick."""
    for c in cells:
        advance_cell(batch, shares, c)
        robots = shares.cells[c].robots
        for i in range(c * robots, (c + 1) * robots):
            rewarded[i, :] = 0.0
            show(batch, i, shown)


@kernel
def step_cells(
    batch: Batch, shares: Shares, actions: NDArray[np.int64], rewarded: NDArray[np.float64], shown: Shown
) -> None:
    """One decision of every robot; cells that have ended stay as they are."""
    for c in range(len(shares.cells)):
        robots = shares.cells[c].robots
        first = c * robots
        if batch.senders[first].waiting == 1:
            for i in range(first, first + robots):
                decide(batch, i, decision_of(actions[i], batch.senders[i].capacity))
                offer(batch, shares, i)
            advance_cell(batch, shares, c)
        for i in range(first, first + robots):
            write_rewards(batch, i, rewarded, shown)
            show(batch, i, shown)


class FleetRows(Rows):
    """``cells`` cells with ``scenario.robots`` robots each: robot r of cell c is row c N + r."""

    def __init__(
        self,
        cells: int,
        *,
        scenario: FleetScenario,
        capacity: int,
        max_bytes: int | None,
        term: str | Mapping[str, float],
        fields: Sequence[str] | None,
    ) -> None:
        super().__init__(
            cells * scenario.robots,
            scenario=scenario.uplink,
            capacity=capacity,
            max_bytes=max_bytes,
            decide_at="arrival",  # every robot at every tick
            reward=term,
            fields=fields,
            parameters={},
        )
        self.fleet_scenario = scenario
        self.fleet = Fleet(self.senders, scenario.robots)

    def seed(self, i: int, rng: np.random.Generator) -> None:
        """Row ``i``'s seed, which counts where it is the first robot of a cell: a cell's chance is drawn as one."""
        if i % self.fleet.robots == 0:
            super().seed(i, rng)

    def reset(self, rows: NDArray[np.int64], episodes: Sequence[Any] | None = None) -> None:
        """Begin a new episode in each cell of ``rows``: the given one (by cell), or the next of its streams."""
        cells = np.unique(rows // self.fleet.robots)
        if len(cells) * self.fleet.robots != len(rows):
            raise BufgymError("reset_mask: the robots of one cell begin together; give all of them or none")
        if episodes is not None and len(episodes) != len(self.fleet):
            raise BufgymError(f"episodes: {len(episodes)} given for {len(self.fleet)} cells; None where one is drawn")
        for c in cells.tolist():
            episode = episodes[c] if episodes is not None else None
            if episode is None:
                first = c * self.fleet.robots
                if self.streams[first] is None:
                    self.seed(first, seeding.np_random()[0])
                episode = self.fleet_scenario.draw(cast(Streams, self.streams[first]))
            elif not episode.ticks_together:
                raise BufgymError("episode: in an environment the messages of all robots arrive at the same times")
            self.fleet.load(c, episode)
        begin_cells(self.senders.batch, self.fleet.shares, cells, self.rewarded, self.shown)

    def step(self, actions: NDArray[np.int64]) -> None:
        """One decision of every robot; ``self.shown`` tells what came of it."""
        step_cells(self.senders.batch, self.fleet.shares, actions, self.rewarded, self.shown)

    def shared(self, rewards: NDArray[np.float64], reward: str) -> NDArray[np.float64]:
        """What each row is paid, float64[rows], of what each has earned."""
        if reward == "own":
            return rewards
        means = rewards.reshape(len(self.fleet), self.fleet.robots).mean(axis=1)
        return np.repeat(means, self.fleet.robots)


def check_reward(reward: Any) -> str:
    """One of ``REWARDS``, or an error."""
    if reward not in REWARDS:
        raise BufgymError(
            f"reward = {reward!r}: must be 'team' (the mean over the robots) or 'own'; its term is `term`"
        )
    return str(reward)

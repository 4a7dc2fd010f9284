"""Rows whose senders are the robots of cells; the robots of a cell share one link."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.rows import NO_ACTIONS, Rows
from bufgym.envs.step import step_cells
from bufgym.envs.threads import Threads
from bufgym.ground.errors import BufgymError
from bufgym.scenario import FleetScenario
from bufgym.sim.cell import Fleet


class FleetRows(Rows):
    """``cells`` cells with N = ``scenario.robots`` robots each. Robot r of cell c is row c N + r.

    The robots of a cell begin an episode together; it is drawn from the streams of the cell's first row.
    """

    def __init__(
        self,
        cells: int,
        scenario: FleetScenario,
        capacity: int,
        *,
        reward: str = "team",
        term: str | Mapping[str, float] = "retained",
        **options: Any,
    ) -> None:
        """``reward`` is "team" or "own", ``term`` is the reward of ``Rows``, and the rest is as in ``Rows``."""
        if reward not in ("team", "own"):
            raise BufgymError(
                f"reward = {reward!r}: must be 'team' (the mean over the robots) or 'own'; its term is `term`"
            )
        n = cells * scenario.robots
        super().__init__(n, scenario.uplink, capacity, reward=term, **options)
        self.reward = reward
        self._draw = self.from_pool(scenario.draw)
        self.robots = scenario.robots
        self.fleet = Fleet(self.senders, scenario.robots)
        self._threads = Threads(np.arange(cells), options.get("num_threads", 1))

    def seed(self, i: int, rng: np.random.Generator) -> None:
        """Give row ``i`` streams of its own if it is the first of its cell; other rows need none."""
        if i % self.robots == 0:
            super().seed(i, rng)

    def reset(self, rows: NDArray[np.int64], episodes: Sequence[Any] | None = None) -> None:
        """Begin a new episode in each cell of ``rows``: ``episodes[c]``, or the next one drawn where that is None."""
        cells = np.unique(rows // self.robots)
        if len(cells) * self.robots != len(rows):
            raise BufgymError("reset_mask: the robots of one cell begin together; give all of them or none")
        if episodes is not None and len(episodes) != len(self.fleet):
            raise BufgymError(f"episodes: {len(episodes)} given for {len(self.fleet)} cells; None where one is drawn")
        for c in cells.tolist():
            episode = episodes[c] if episodes is not None else None
            if episode is None:
                self.fleet.load(c, *self._next_episode(c * self.robots))
                continue
            if not episode.ticks_together:
                raise BufgymError("episode: in an environment the messages of all robots arrive at the same times")
            self.fleet.load(c, episode)
        step_cells(self.senders.batch, self.fleet.shares, cells, NO_ACTIONS, self.rewarded, self.output)
        if self._has_own:
            self._begin_own(rows)

    def step(self, actions: NDArray[np.int64]) -> None:
        """Apply one decision of every robot; the result is in ``self.output``."""
        batch, shares, rewarded, output = self.senders.batch, self.fleet.shares, self.rewarded, self.output
        self._threads.each(lambda cells: step_cells(batch, shares, cells, actions, rewarded, output))
        if self._has_own:
            self._step_own()

    def rewards(self) -> NDArray[np.float64]:
        """float64[rows]: each robot's own weighted sum, or for a "team" the mean within its cell."""
        own = super().rewards()
        if self.reward == "own":
            return own
        return np.repeat(own.reshape(len(self.fleet), self.robots).mean(axis=1), self.robots)

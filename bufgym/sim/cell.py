"""Fleets that hold episodes, and the run of a policy on every robot of a cell."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bufgym.model.checks import whole
from bufgym.model.qoi import Value
from bufgym.policies.registry import Policy
from bufgym.scenario.fleet import MAX_ROBOTS, FleetEpisode
from bufgym.sim.senders import Senders
from bufgym.sim.shared_link import load_cell, new_shares
from bufgym.utils.errors import BufgymError


class Fleet:
    """Cells with N robots each. Robot r of cell c is row c N + r of ``senders``, which all share L, B and V."""

    def __init__(self, senders: Senders, robots: int) -> None:
        """Make as many cells of N = ``robots`` robots as there are senders for; nothing is loaded yet."""
        self.robots = whole("robots", robots, 1, MAX_ROBOTS)
        if len(senders) % self.robots or senders.topics:
            raise BufgymError(
                f"a fleet of {self.robots} robots needs a multiple of that many senders, of one queue each"
            )
        self.senders = senders
        self.shares = new_shares(len(senders) // self.robots, self.robots)

    def __len__(self) -> int:
        return len(self.shares.cells)

    def rows(self, c: int) -> range:
        """The rows of the senders of cell ``c``."""
        return range(c * self.robots, (c + 1) * self.robots)

    def load(self, c: int, episode: FleetEpisode, uniforms: np.random.Generator | None = None) -> None:
        """Begin ``episode`` in cell ``c``: empty buffers, idle sockets, nothing arrived; ``uniforms`` as in Senders."""
        if not isinstance(episode, FleetEpisode):
            raise BufgymError(f"episode: {episode!r} is not a bufgym.scenario FleetEpisode")
        if episode.robots != self.robots:
            raise BufgymError(f"episode of {episode.robots} robots: the cell has {self.robots}")
        self.senders.load_all([(i, episode.episode(robot), uniforms) for robot, i in enumerate(self.rows(c))])
        # After the senders, as it reads their links and first arrivals.
        load_cell(self.senders.batch, self.shares, c)

    def run(self, policy: Policy, memory: NDArray[np.float64] | None = None) -> None:
        """Run every loaded cell to its end with ``policy`` on each robot; ``memory`` is float64[rows, entries]."""
        if policy.privileged is not None:
            raise BufgymError(f"policy {policy.name}: it plans with a link of its own, which no robot in a cell has")
        self.senders.run(policy, memory, self.shares)


def run_fleet(
    policy: Policy,
    episodes: Sequence[FleetEpisode],
    capacity: int,
    v: Value,
    *,
    max_bytes: int | None = None,
    decide_at: str = "arrival",
    memory: NDArray[np.float64] | None = None,
) -> Fleet:
    """Run ``policy`` on every robot through each of ``episodes``, one cell each; return the fleet afterwards.

    ``metrics.outcome(fleet.senders, i)`` for i in ``fleet.rows(c)`` gives the statistics of the robots of cell c.
    """
    if not episodes:
        raise BufgymError("no episode to run")
    robots = episodes[0].robots
    longest = max(len(arrivals) for episode in episodes for arrivals in episode.arrivals)
    if policy.unbounded:
        capacity, max_bytes = longest, None
    n = robots * len(episodes)
    senders = Senders(n, capacity, v, max_messages=longest, max_bytes=max_bytes, decide_at=decide_at)
    fleet = Fleet(senders, robots)
    for c, episode in enumerate(episodes):
        fleet.load(c, episode)
    fleet.run(policy, memory)
    fleet.senders.check_untouched(policy)
    return fleet

"""Fleets that hold episodes, and the main loop for a policy that runs on every robot."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.kernel import compile_for, records
from bufgym.model.link import FOREVER
from bufgym.model.qoi import Value
from bufgym.policies.registry import Policy, runs_compiled, signatures
from bufgym.scenario.fleet import FleetEpisode, check_robots
from bufgym.sim import (
    DECISION,
    DEQUEUE,
    END,
    SEND,
    Batch,
    Senders,
    answer_dequeue,
    answer_send,
    arrival_of,
    ask,
    batch_type,
    credit,
    named,
    view,
)
from bufgym.sim.shared_link import CELL, Shares, cell_event, decide_in_cell, load_cell, shares_type


def fleet_rollout(
    batch: Batch,
    shares: Shares,
    memory: NDArray[np.float64],
    on_arrival: Any,
    on_departure: Any,
    on_dequeue: Any,
    on_send: Any,
    hears_departures: bool,
) -> None:
    """Run every cell to its end, one policy on each robot; ``memory`` is float64[rows, entries], each robot's own."""
    for c in range(len(shares.cells)):
        event = cell_event(batch, shares, c)
        while event != END:
            i = shares.cells[c].row
            if event == DECISION:
                decide_in_cell(batch, shares, c, i, on_arrival(view(batch, i), arrival_of(batch, i), memory[i]))
            elif event == DEQUEUE:
                answer_dequeue(batch, i, on_dequeue(view(batch, i), memory[i]))
            elif event == SEND:
                answer_send(batch, i, on_send(view(batch, i), memory[i]))
            elif hears_departures:
                on_departure(view(batch, i), memory[i])
            event = cell_event(batch, shares, c)
    for i in range(len(batch.senders)):
        credit(batch, i, FOREVER)


@functools.cache
def compiled_fleet_rollout() -> Any:
    """``fleet_rollout`` compiled once for every policy (policies arrive as values of one function type)."""
    functions = tuple(numba.types.FunctionType(signature) for signature in signatures())
    memory = numba.types.Array(numba.types.float64, 2, "C")
    made = numba.types.void(batch_type(), shares_type(), memory, *functions, numba.types.boolean)
    return compile_for(made, fleet_rollout)


def python_fleet_rollout(batch: Batch, shares: Shares, memory: NDArray[np.float64], policy: Policy) -> None:
    """``fleet_rollout`` for a policy that is ordinary Python: the transition stays compiled."""
    seen = named(batch)
    for c in range(len(shares.cells)):
        event = cell_event(batch, shares, c)
        while event != END:
            i = int(shares.cells["row"][c])
            ask(policy, batch, seen, i, event, memory[i], functools.partial(_decide, shares, c))
            event = cell_event(batch, shares, c)
    for i in range(len(batch.senders)):
        credit(batch, i, FOREVER)


def _decide(shares: Shares, c: int, batch: Batch, i: int, decision: int) -> None:
    decide_in_cell(batch, shares, c, i, decision)


class Fleet:
    """Cells with N robots each: robot r of cell c is row c N + r of ``senders``, whose L, B and V all of them share."""

    def __init__(self, senders: Senders, robots: int) -> None:
        """``robots``: N; as many cells as the senders make. Nothing is loaded yet."""
        self.robots = check_robots(robots)
        if len(senders) % self.robots or senders.topics:
            raise BufgymError(
                f"a fleet of {self.robots} robots needs a multiple of that many senders, of one queue each"
            )
        self.senders = senders
        cells = len(senders) // self.robots
        self.shares = Shares(
            records(cells, CELL), np.zeros((cells, self.robots), np.int64), np.zeros((cells, self.robots), np.int64)
        )

    def __len__(self) -> int:
        return len(self.shares.cells)

    def rows(self, c: int) -> range:
        """The rows of the senders of cell ``c``."""
        return range(c * self.robots, (c + 1) * self.robots)

    def load(self, c: int, episode: FleetEpisode) -> None:
        """Begin ``episode`` in cell ``c``: empty buffers, idle sockets, nothing arrived."""
        if episode.robots != self.robots:
            raise BufgymError(f"episode of {episode.robots} robots: the cell has {self.robots}")
        for robot, i in enumerate(self.rows(c)):
            self.senders.load(i, episode.episode(robot))
        load_cell(self.senders.batch, self.shares, c)

    def run(self, policy: Policy, memory: NDArray[np.float64] | None = None) -> None:
        """Run every loaded cell to its end, ``policy`` on each robot; ``memory``: float64[rows, entries]."""
        if policy.privileged is not None:
            raise BufgymError(f"policy {policy.name}: it plans with a link of its own, which no robot in a cell has")
        if memory is None:
            memory = policy.new_memory(len(self.senders), self.senders.capacity)
        batch = self.senders.batch._replace(parameters=policy.parameter_array)
        batch.senders["ask_at_dequeue"], batch.senders["ask_at_send"] = policy.drops_at_dequeue, policy.schedules
        if runs_compiled(policy):
            compiled_fleet_rollout()(batch, self.shares, memory, *policy.compiled, policy.hears_departures)
        else:
            python_fleet_rollout(batch, self.shares, memory, policy)


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
    """The fleet after ``policy``, on every robot, met each of ``episodes``, one cell each.

    ``metrics.outcome(fleet.senders, i)`` for i in ``fleet.rows(c)`` tells how the robots of cell c fared.
    """
    if not episodes:
        raise BufgymError("no episode to run")
    robots = episodes[0].robots
    longest = max(len(arrivals) for episode in episodes for arrivals in episode.arrivals)
    senders = Senders(
        robots * len(episodes),
        longest if policy.unbounded else capacity,
        v,
        max_messages=longest,
        max_bytes=max_bytes,
        decide_at=decide_at,
    )
    fleet = Fleet(senders, robots)
    for c, episode in enumerate(episodes):
        fleet.load(c, episode)
    fleet.run(policy, memory)
    return fleet

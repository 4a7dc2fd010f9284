"""Experiment of ``bufgym bench``: every policy meets the same episodes, and each run becomes rows.

The method is common random numbers. Seed s stands for one episode and one sequence of uniform draws, whatever the
policy, the capacity and the order of runs. Two runs with the same trace and seed differ only in policy and capacity, so
their difference has no noise from the draw. Each trace of a scenario has the full set of seeds.
"""

from collections.abc import Sequence
from typing import Any

from bufgym.benchmark import tasks
from bufgym.benchmark.rows import Row
from bufgym.policies import Policy, names
from bufgym.scenario.numbered import by_trace, draw
from bufgym.utils.errors import BufgymError
from bufgym.utils.progress import bar

_BATCH_MESSAGES = 1_000_000  # messages held at a time, 88 bytes each; many seeds run in several batches


def run(
    policies: Sequence[Policy],
    scenario: Any,
    capacities: Sequence[int],
    seeds: int | Sequence[int],
    *,
    label: str = "",
    progress: bool = False,
    **settings: Any,
) -> list[Row]:
    """Run every policy at every capacity on every trace and seed; return rows in the task's ``layout``.

    Args:
        scenario: a ``Scenario`` or a ``FleetScenario``; each of its traces is met on its own.
        seeds: a number of seeds counted from 0, or a list of seeds.
        label: name of the scenario in the rows.
        settings: settings of the task; for one queue ``max_bytes``, ``decide_at`` and ``bound``, see ``QueueTask``.
    """
    task = tasks.task_for(scenario, **settings)
    numbers = list(range(seeds)) if isinstance(seeds, int) else list(seeds)
    for name, entries in (("policies", policies), ("capacities", capacities), ("seeds", numbers)):
        if not entries:
            raise BufgymError(f"{name} = {seeds if name == 'seeds' else list(entries)}: need at least one")
    check_distinct(policies)
    for policy in policies:
        task.check(policy)
    parts = by_trace(scenario)
    at_once = max(1, _BATCH_MESSAGES // task.messages(scenario))
    batches = [numbers[k : k + at_once] for k in range(0, len(numbers), at_once)]
    rows: list[Row] = []
    with bar(len(parts) * len(numbers) * len(capacities) * len(policies), progress) as advance:
        for trace, part in parts:
            for batch in batches:
                episodes = [draw(part, seed) for seed in batch]
                for capacity in capacities:
                    for policy, results in zip(policies, task.play(policies, part, episodes, capacity), strict=True):
                        for seed, result in zip(batch, results, strict=True):
                            key = {"scenario": label, "trace": trace, "seed": seed}
                            key |= {"policy": policy.name, "capacity": capacity}
                            for cells in result:
                                row = key | cells
                                task.verify(policy, row)
                                rows.append({name: row[name] for name in task.layout})
                        advance(len(batch))
    return rows


def check_distinct(policies: Sequence[Policy]) -> None:
    """Raise an error if two policies have one name, because their rows could not be told apart."""
    given = [policy.name for policy in policies]
    for name in given:
        if given.count(name) > 1:
            own = [p for p in policies if p.name == name and not p.built_in]
            why = f"; {name!r} is a built-in policy's name, give your own another" if own and name in names() else ""
            raise BufgymError(f"policies: {name!r} is given more than once{why}")

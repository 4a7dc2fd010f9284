"""The plans of ``bufgym.policies.small_queue``: ``python -m agents.small_queue bufgym/policies/small_queue.txt``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from tyro.conf import Positional

from bufgym.ground.files import replaced
from bufgym.model import qoi
from bufgym.model.buffer import REJECT
from bufgym.oracle import law, online_optimum
from bufgym.policies.small_queue import BASES, CAPACITIES, LONGEST
from bufgym.scenario import Interruption

SOLVED = {1: 400, 2: 300, 3: 120, 4: 70}
"""L, and the longest T for which the online optimum's table fits into memory."""
BEAM = 1000
"""Queues that the beam follows at a time beyond that."""


def plan(base: float, L: int) -> list[int]:
    """Evictions from a full queue at an interruption's arrivals L + 1, L + 2, ...; L stands for the newcomer.

    T is log-uniform on 1..SOLVED[L], for which the plan is the online optimum. A longer one is taken as log-uniform on
    1..LONGEST, for which a beam search continues the plan. Nothing is learned meanwhile, so one list serves all T.
    """
    scenario = Interruption(value=qoi.exponential(base), t_max=SOLVED[L])
    optimum = online_optimum(L, law(scenario), scenario.value, objective="qoi")
    kept, evicted = list(range(1, L + 1)), []
    for t in range(L + 1, SOLVED[L] + 1):
        kept.append(t)
        decision = optimum.decision(kept)
        evicted.append(L if decision == REJECT else decision)
        del kept[evicted[-1]]
    return evicted + continued(base, np.array(kept), SOLVED[L])


def continued(base: float, kept: NDArray[np.int64], begin: int) -> list[int]:
    """The plan for arrivals ``begin`` + 1 to LONGEST of a queue that then holds ``kept``, by beam search.

    Queues are compared by their gain so far plus the gain if nothing came after.
    """
    p = law(Interruption(value=qoi.exponential(base), t_max=LONGEST))
    beyond = np.append(p[::-1].cumsum()[::-1], 0.0)  # P(T >= t)
    queues, given, past = kept[None], np.zeros(1), []
    places = (LONGEST + 1) ** np.arange(len(kept))
    for t in range(begin + 1, LONGEST + 1):
        slots = np.arange(len(kept) + 1)
        full = np.insert(queues, len(kept), t, axis=1)
        after = np.concatenate([np.delete(full, slot, axis=1) for slot in slots])
        ends = np.insert(np.insert(after, 0, 0, axis=1), len(kept) + 1, t + 1, axis=1)
        information = (1 - base ** np.diff(ends, axis=1)).sum(axis=1)
        so_far = np.tile(given, len(slots)) + p[t] * information
        order = np.argsort(-(so_far + beyond[t + 1] * information), kind="stable")
        _, unlike = np.unique(after[order] @ places, return_index=True)
        chosen = order[np.sort(unlike)[:BEAM]]
        past.append((chosen % len(queues), chosen // len(queues)))
        queues, given = after[chosen], so_far[chosen]
    k, evicted = int(np.argmax(given)), []
    for before, slot in reversed(past):
        evicted.append(int(slot[k]))
        k = int(before[k])
    return evicted[::-1]


def main(out: Positional[Path]) -> None:
    """Make every plan and write them.

    Args:
        out: text file to write.
    """
    plans = (f"{base:.6f} {L} {''.join(map(str, plan(base, L)))}\n" for base in BASES for L in CAPACITIES)
    with replaced(out) as temporary:
        temporary.write_text("".join(plans), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)

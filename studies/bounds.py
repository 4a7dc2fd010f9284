"""How far the clairvoyant's bound lies above the best, for messages of unequal sizes, by the size of the episode.

``python -m studies.bounds [--episodes N]``

Up to twelve messages every set of messages to keep is played, so the best is known. Above, the plan that comes with the
bound is played: the best lies between the two. A plan that reaches its bound is certified.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bufgym import policies, scenario
from bufgym.cli.options import Count
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.oracle.clairvoyant import clairvoyant
from bufgym.scenario import Episode, messages
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace
from bufgym.utils.tables import Table
from studies.page import command

TINY, LONG = (4, 6, 8, 10, 12), (30, 90, 300, 900)
"""Messages of an episode: where every set is played, and where the plan is."""
CAPACITY = 8
V = qoi.exponential(0.4)


def tiny(n: int, seed: int) -> tuple[Episode, int]:
    """A made-up episode of n messages that get in each other's way, and its L."""
    rng = np.random.default_rng([n, seed])
    us, size = np.cumsum(rng.choice([0, 300, 900, 2_000], n)), rng.integers(1, 8, n) * 1_201
    x = np.cumsum(rng.choice([0, 0.25, 1, 2.5], n))
    carried = np.array([0, int(rng.integers(2, 9)) * 1_500, 12_000, 24_000])
    trace = Trace("made up", np.array([0, 4_000, 5_000 + 2_000 * (seed % 2), 14_000]), carried, "loop")
    return Episode(messages(us, size, x), Link(trace)), int(rng.integers(2, 4))


def best_of_all(episode: Episode, capacity: int) -> float:
    """H of the best set of messages to keep: each one is played, by a sender of its own."""
    n = len(episode.arrivals)
    kept = ((np.arange(2**n)[:, None] >> np.arange(n)) & 1).astype(np.float64)
    senders = Senders(len(kept), capacity, V, max_messages=n)
    senders.load_all([(i, episode, None) for i in range(len(kept))])
    senders.run(replace(policies.get("clairvoyant"), privileged=None), kept)
    return max(outcome(senders, i).qoi for i in range(len(kept)))


def excess(n: int, episodes: int) -> Iterator[tuple[float, bool]]:
    """(how far the bound is above the best, as a fraction of it; whether it is certified) for each episode."""
    for seed in range(episodes):
        if n in TINY:
            episode, capacity = tiny(n, seed)
            reached, plan = best_of_all(episode, capacity), clairvoyant(episode, capacity, V)
        else:
            lte = scenario.get("lte", duration_s=n / 30, size_bytes=400_000, size_cv=1.0)
            episode = draw(lte, seed)
            plan = clairvoyant(episode, CAPACITY, lte.value)
            reached = lte.value.information(np.asarray(episode.arrivals)["x"][plan.kept])
        yield plan.qoi / reached - 1 if reached > 0 else 0.0, plan.certified


def main(*, episodes: Count = 20) -> None:
    """Measure how far the clairvoyant's bound lies above the best.

    Args:
        episodes: So many of each size.
    """
    rows = []
    for n in (*TINY, *LONG):
        above, certified = map(np.array, zip(*excess(n, episodes), strict=True))
        share, mean, most = f"{certified.mean():.0%}", f"{above.mean():.2%}", f"{above.max():.2%}"
        rows.append([f"{n}", "best of all" if n in TINY else "plan that comes with it", share, mean, most])
    print(Table(["messages", "bound above the", "certified", "mean", "most"], [("", rows)]).plain())


if __name__ == "__main__":
    command(main)

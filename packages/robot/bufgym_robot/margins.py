"""By how much a policy beats another on real sockets, and by how much in the simulator, over the same episodes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bufgym.benchmark.bootstrap import Interval, interval, ratio, stream, times_drawn, written
from bufgym.benchmark.episodes import Numbers
from bufgym.benchmark.table import percent
from bufgym_robot.runs import LiveRun, by_policy


@dataclass(frozen=True)
class Margin:
    """How much lower a policy's regret is than the reference's, with intervals over the episodes that both met."""

    policy: str
    reference: str
    episodes: int
    live: Interval
    simulated: Interval
    share: Interval  # live over simulated

    def __str__(self) -> str:
        numbers = (self.live, self.simulated, self.share)
        live, simulated, share = (" ".join(written(number, percent)).strip() for number in numbers)
        lower = f"{self.policy} against {self.reference}, {self.episodes} episodes: regret lower by"
        there = f": {share} of the simulator's margin is there live" if self.simulated.value > 0 else ""
        return f"{lower} {live} live, {simulated} simulated{there}."


def margins(runs: Sequence[LiveRun], reference: str = "afr") -> list[Margin]:
    """Of each other policy, the best in the simulator first; none without the reference or with a single episode.

    Regret is on sums over the episodes. Intervals are paired bootstraps over them (see ``bootstrap.interval``): live
    and simulated runs of an episode, and those over several transports, are drawn together.
    """
    policies = by_policy(runs)
    if reference not in policies:
        return []
    found = []
    for policy in policies:
        sums = _sums([one for one in runs if one.policy == policy], policies[reference])
        if policy == reference or len(sums) < 2:
            continue
        weights = times_drawn(len(sums), 2000, stream(0, policy))
        live, simulated, best = (weights @ sums).T
        known = best > 0
        numbers = ratio(live, best, known), ratio(simulated, best, known), ratio(live, simulated, simulated > 0)
        found.append(Margin(policy, reference, len(sums), *(interval(n, len(sums)) for n in numbers)))
    return found


def _sums(ours: Sequence[LiveRun], theirs: Sequence[LiveRun]) -> Numbers:
    """[episodes, 3] over the transports of each: H less the other's H, live and simulated, and the clairvoyant's."""
    episodes: dict[tuple[str, int], list[float]] = {}
    others = {(one.transport, one.link, one.seed): one for one in theirs}
    for one in ours:
        other = others.get((one.transport, one.link, one.seed))
        if other is not None:
            sums = episodes.setdefault((one.link, one.seed), [0.0, 0.0, 0.0])
            sums[0] += one.live_qoi - other.live_qoi
            sums[1] += one.simulated_qoi - other.simulated_qoi
            sums[2] += one.best_qoi
    return np.array(list(episodes.values())).reshape(-1, 3)

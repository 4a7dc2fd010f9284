"""Distance of H from the best: regret, and the score between Drop Oldest and the clairvoyant."""

from typing import Any

import numpy as np

from bufgym import policies
from bufgym.model.buffer import UNLIMITED_BYTES
from bufgym.oracle.clairvoyant import clairvoyant
from bufgym.sim import Senders, run
from bufgym.sim.metrics import outcome

BASELINE = "drop-oldest"
"""The policy of score 0: the drop rule of ROS."""

TIE = 1e-9  # Relative difference up to which two H are equal: they sum the same gaps in another order

MEASURED = ("clairvoyant", "certified", "regret", "score")  # The entries of ``measured``


def regret(h: float, most: float) -> float:
    """1 - H / H of the clairvoyant; 0 if nothing could be delivered at all."""
    return 1 - h / most if most > 0 else 0.0


def normalised_score(h: Any, base: Any, best: Any) -> Any:
    """(sum H - sum H_baseline) / (sum H_clairvoyant - sum H_baseline), from the three sums; not clipped.

    0 is the baseline Drop Oldest, 1 the clairvoyant. NaN if the baseline leaves nothing to gain.
    """
    gap = np.asarray(best, np.float64) - base
    return np.divide(h - base, gap, out=np.full_like(gap + h, np.nan), where=gap > TIE * np.abs(best))


def measured(senders: Senders, i: int, h: float) -> dict[str, float]:
    """Rate ``h`` on the episode of sender ``i``, of one queue; this takes a tenth of a second on long episodes.

    ``clairvoyant`` is the best H; where ``certified`` is 0, it is an upper bound of it (see ``Plan``).
    """
    episode, v, capacity = senders.episodes[i], senders.value_of(i), senders.capacity
    assert episode is not None
    most_bytes = None if senders.max_bytes >= UNLIMITED_BYTES else senders.max_bytes
    plan = clairvoyant(episode, capacity, v, max_bytes=most_bytes)
    best = plan.qoi
    rolled = run(policies.get(BASELINE), [episode], capacity, v, max_bytes=most_bytes, decide_at=senders.decide_at)
    score = float(normalised_score(h, outcome(rolled, 0).qoi, best))
    return {"clairvoyant": best, "certified": float(plan.certified), "regret": regret(h, best), "score": score}

"""The quality of a finished episode, between Drop Oldest's H and the clairvoyant's bound."""

from __future__ import annotations

from bufgym import policies
from bufgym.ground.errors import BufgymError
from bufgym.model.buffer import UNLIMITED_BYTES
from bufgym.oracle import clairvoyant
from bufgym.oracle.measure import BASELINE, normalised_score, regret
from bufgym.sim import Senders, run
from bufgym.sim.metrics import outcome

BOUND = ("clairvoyant", "regret", "score")
"""The entries of ``measured``."""


def check_one_queue(senders: Senders) -> None:
    """Raise a BufgymError unless the episode is one queue with a known clairvoyant."""
    if senders.topics:
        raise BufgymError("bound = True: the clairvoyant is known for one queue, not for several topics")


def measured(senders: Senders, i: int, h: float) -> dict[str, float]:
    """Rate ``h`` on the episode of sender ``i``; this takes a tenth of a second on long episodes.

    ``clairvoyant`` is the best H or an upper bound of it (see ``oracle.Plan``). ``regret`` is the share of it that was
    lost. ``score`` is 0 for Drop Oldest and 1 for the clairvoyant, or NaN where the two are equal.
    """
    episode, v, capacity = senders.episodes[i], senders.value_of(i), senders.capacity
    assert episode is not None
    most_bytes = None if senders.max_bytes >= UNLIMITED_BYTES else senders.max_bytes
    best = clairvoyant(episode, capacity, v, max_bytes=most_bytes).qoi
    baseline = policies.get(BASELINE)
    rolled = run(baseline, [episode], capacity, v, max_bytes=most_bytes, decide_at=senders.decide_at)
    score = float(normalised_score(h, outcome(rolled, 0).qoi, best))
    return {"clairvoyant": best, "regret": regret(h, best), "score": score}

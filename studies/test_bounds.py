"""The best of all sets is the best, and a certified bound is exactly it."""

import numpy as np

from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.traces import Trace
from studies import bounds


def test_the_best_set_is_found_by_playing_all() -> None:
    """Room for one; the first message is on the link until all have come: one more can wait. 2 ahead gains V(2)."""
    trace = Trace("slow", np.array([0, 1_000]), np.array([0, 100]), "loop")
    episode = Episode(messages(np.array([0, 10, 20]), np.array([10, 11, 12])), Link(trace))
    assert bounds.best_of_all(episode, 1) == 1 + bounds.V(2.0)
    assert bounds.best_of_all(episode, 2) == 1 + 2 * bounds.V(1.0)


def test_no_bound_lies_below_the_best_and_a_certified_one_on_it() -> None:
    found = list(bounds.excess(4, 6)) + list(bounds.excess(8, 12))
    assert all(above >= -1e-9 for above, _ in found)
    assert all(above < 1e-9 for above, certified in found if certified)
    assert any(certified for _, certified in found) and not all(certified for _, certified in found)

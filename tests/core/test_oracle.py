"""Optima: the oracle of one interruption, that over a small link, and plans for small queues."""

import functools
import itertools
import math
from itertools import combinations

import numpy as np
import pytest
from cases import VALUES
from hypothesis import given
from hypothesis import strategies as st

from bufgym import policies
from bufgym.ground.errors import BufgymError
from bufgym.model import qoi
from bufgym.oracle import by_length, clairvoyant, ideal, integer, law
from bufgym.papers.link_optimum import ASKED, QUARTERS, Chain, cut_off, small_link
from bufgym.papers.small_link import episode
from bufgym.scenario import Interruption, Streams, registry
from bufgym.sim import run

# The number of examples is set where one of them is hundreds of runs.


kernels = pytest.mark.kernels


@kernels
def test_by_hand():
    v = qoi.exponential(0.5)
    # L = 1, T = 2: keep 1 or 2 of 0, 1, 2, 3: gaps 1 and 2, V = 1/2 + 3/4.
    assert integer(1, 2, v) == 1.25
    # As if the gaps could be 1.5 and 1.5.
    assert ideal(1, 2, v) == pytest.approx(2 * (1 - 0.5**1.5))
    # With room for all, nothing is lost: T + 1 gaps of 1.
    assert integer(5, 3, v) == ideal(5, 3, v) == 4 * 0.5
    assert integer(1, 0, v) == 0.5


@kernels
def test_the_law_of_t_by_hand():
    assert law(Interruption(law="uniform", t_min=1, t_max=4)).tolist() == [0, 0.25, 0.25, 0.25, 0.25]
    assert law(Interruption(law="uniform", t_min=1, t_max=4, lengths=(1, 2))).tolist() == [0, 0.5, 0.5, 0, 0]


@kernels
def test_one_run_tells_of_every_shorter_interruption():
    """Messages 1, 2, 3 arrive, L = 1: the second evicts the first, the third is rejected; message 4 follows."""
    v = qoi.exponential(0.5)
    h = by_length(np.array([9, 2, 9, 3, 9]), v)
    # T = 0: 0, 1. T = 1: 0, 1, 2. T = 2: 0, 2, 3. T = 3: 0, 2, 4.
    assert h.tolist() == [1 + v(1), 1 + 2 * v(1), 1 + v(2) + v(1), 1 + 2 * v(2)]


@kernels
@given(VALUES, st.integers(1, 5), st.integers(0, 10))
def test_is_the_best_of_all_subsets(v, L, T):
    best = max(
        math.fsum(np.vectorize(v)(np.diff([0, *kept, T + 1]))) for kept in combinations(range(1, T + 1), min(L, T))
    )
    assert integer(L, T, v) == pytest.approx(best, abs=1e-12)
    assert ideal(L, T, v) >= best - 1e-12


LENGTHS = range(1, 81)
EPISODES = [Interruption(t_max=80).episode(T).with_uniforms(np.random.default_rng(T)) for T in LENGTHS]


@given(VALUES, st.integers(1, 12), st.sampled_from([name for name in policies.names() if policies.get(name).ranked]))
def test_no_policy_beats_it(v, L, name):
    gained = run(policies.get(name), EPISODES, L, v).batch.senders["delivered_gain"]
    assert (gained <= np.array([integer(L, T, v) for T in LENGTHS]) + 1e-9).all()


@pytest.mark.parametrize("limits", [{}, {"max_bytes": 3 * 230_000}])
def test_as_a_policy_it_reaches_its_number(limits):
    v = qoi.exponential()
    for L in (1, 3, 8):
        senders = run(policies.get("oracle"), EPISODES, L, v, **limits)
        best = [integer(min(L, 3) if limits else L, T, v) for T in LENGTHS]
        assert senders.batch.senders["delivered_gain"] == pytest.approx(best, abs=1e-9)
        assert not senders.batch.senders["invalid"].any()


def test_as_a_policy_it_plays_one_interruption_only():
    assert "oracle" not in policies.names() and "oracle" in policies.names(named_only=True)
    assert policies.get("oracle").unranked_because == "it knows the future"
    with pytest.raises(BufgymError, match="policy oracle: it plans for one interruption"):
        run(policies.get("oracle"), [registry.get("lte").draw(Streams.seeded(0))], 4, qoi.exponential())


def test_l_and_t_are_checked():
    for truth in (ideal, integer):
        for L, T in ((0, 5), (3, -1)):
            with pytest.raises(BufgymError, match=f"oracle: L = {L}, T = {T}: need L >= 1 and T >= 0"):
                truth(L, T, qoi.exponential())


CUT = cut_off(qoi.exponential(0.5), 4)
"""CUT(1..4) = 1/2, 3/4, 7/8, 15/16."""


def searched(L, chain, arrivals, asked):
    """E[H]: every decision tried at every arrival, over the messages themselves and the mean over all rates."""
    matrix = chain.matrix

    def gain(a, b):
        return CUT(float(min(b - a, 4)))

    def carried(last, queue, left, quarters):
        """What one period makes of the message dequeued last, the queue, the socket, and what it gains."""
        gained = 0.0
        while left and quarters >= left:
            quarters, left = quarters - left, 0
            if queue:
                gained, last, queue, left = gained + gain(last, queue[0]), queue[0], queue[1:], 4
        return last, queue, left - quarters if left else 0, gained

    @functools.cache
    def behind(t, last, queue, left, state):
        """Of the periods from arrival t on, once it has been decided on."""
        if t == arrivals - 1:
            whole = (last, *queue)
            return sum(gain(a, b) for a, b in itertools.pairwise(whole))
        mean = 0.0
        for rate, probability in enumerate(matrix[state]):
            *then, gained = carried(last, queue, left, int(QUARTERS[rate]))
            mean += probability * (gained + ahead(t + 1, *then, rate))
        return mean

    def ahead(t, last, queue, left, state):
        if left == 0:
            taken = gain(last, t) + behind(t, t, (), 4, state)
            return max(taken, behind(t, last, (), 0, state)) if asked == "always" else taken
        full = len(queue) == L
        choices = [] if full else [(*queue, t)]
        if full or asked != "full":
            choices += [queue, *((*queue[:k], *queue[k + 1 :], t) for k in range(len(queue)))]
        return max(behind(t, last, choice, left, state) for choice in choices)

    return 1 + np.mean([behind(0, 0, (), 4, state) for state in range(4)])


@kernels
def test_a_small_link_by_hand():
    # Two arrivals: message 0 is in the socket, 1 waits and is sent at the end. H = 1 + V(1).
    assert small_link(1, CUT, Chain(), arrivals=2).value == pytest.approx(1.5)
    # Three, at rates that never change. At 1 and 1/2 the socket has taken 1 when 2 arrives: all get there, 1 + 2 V(1).
    # At 0 and 1/4 message 0 is still in it: one of 1 and 2 must go, and 1 + V(2) is more than 1 + V(1).
    assert small_link(1, CUT, Chain(1.0), arrivals=3).value == pytest.approx((2 + 2 + 1.75 + 1.75) / 4)


@kernels
@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize(("L", "arrivals"), [(1, 5), (2, 5), (3, 4)])
def test_it_is_what_a_search_of_every_decision_finds(L, arrivals, asked):
    solved = small_link(L, CUT, Chain(0.9), arrivals=arrivals, depth=4, asked=asked)
    assert solved.value == pytest.approx(searched(L, Chain(0.9), arrivals, asked), abs=1e-12)


@pytest.mark.parametrize("asked", ["full", "busy"])
def test_its_policy_reaches_its_value_in_the_simulator(asked):
    # Over every course of the rates, each with its probability: the mean is exact, not drawn.
    chain, arrivals, L = Chain(0.7), 5, 2
    courses = np.indices((4,) * (arrivals - 1)).reshape(arrivals - 1, -1).T
    weights = chain.matrix.mean(axis=0)[courses[:, 0]]
    for k in range(1, arrivals - 1):
        weights = weights * chain.matrix[courses[:, k - 1], courses[:, k]]
    episodes = [episode(np.append(course, 3)) for course in courses]
    solved = small_link(L, CUT, chain, arrivals=arrivals, depth=4, asked=asked)
    reached = 1 + weights @ run(solved.policy(), episodes, L, CUT).batch.senders["delivered_gain"]
    assert reached == pytest.approx(solved.value, abs=1e-9)
    best = weights @ [clairvoyant(each, L, CUT).qoi for each in episodes]
    for name in ("min-gap", "drop-oldest"):
        other = 1 + weights @ run(policies.get(name), episodes, L, CUT).batch.senders["delivered_gain"]
        assert other <= reached + 1e-9 <= best + 2e-9


def test_a_chain_draws_its_own_law():
    states = Chain(0.8).draw(20_000, np.random.default_rng(1))
    assert np.bincount(states) / len(states) == pytest.approx([0.25] * 4, abs=0.03)
    assert np.mean(states[1:] == states[:-1]) == pytest.approx(0.8, abs=0.01)


def test_what_it_can_not_solve_is_an_error():
    with pytest.raises(BufgymError, match="asked = 'never'"):
        small_link(1, CUT, Chain(), arrivals=2, asked="never")
    with pytest.raises(BufgymError, match="too many states"):
        small_link(9, CUT, Chain(), arrivals=2)
    with pytest.raises(BufgymError, match=r"stays = 2"):
        Chain(2)

"""The exact optimum over a small link: by hand, against a search of every decision, and played in the simulator."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

from bufgym import policies
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.oracle import clairvoyant
from bufgym.oracle.small_link import ASKED, QUARTERS, Chain, cut_off, small_link
from bufgym.reproduce.small_link import episode
from bufgym.sim import run

kernels = pytest.mark.kernels
V = cut_off(qoi.exponential(0.5), 4)
"""V(1..4) = 1/2, 3/4, 7/8, 15/16."""


def searched(L, chain, arrivals, asked):
    """E[H]: every decision tried at every arrival, over the messages themselves and the mean over all rates."""
    matrix = chain.matrix

    def gain(a, b):
        return V(float(min(b - a, 4)))

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
def test_by_hand():
    # Two arrivals: message 0 is in the socket, 1 waits and is sent at the end. H = 1 + V(1).
    assert small_link(1, V, Chain(), arrivals=2).value == pytest.approx(1.5)
    # Three, at rates that never change. At 1 and 1/2 the socket has taken 1 when 2 arrives: all get there, 1 + 2 V(1).
    # At 0 and 1/4 message 0 is still in it: one of 1 and 2 must go, and 1 + V(2) is more than 1 + V(1).
    assert small_link(1, V, Chain(1.0), arrivals=3).value == pytest.approx((2 + 2 + 1.75 + 1.75) / 4)


@kernels
@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize(("L", "arrivals"), [(1, 5), (2, 5), (3, 4)])
def test_it_is_what_a_search_of_every_decision_finds(L, arrivals, asked):
    solved = small_link(L, V, Chain(0.9), arrivals=arrivals, depth=4, asked=asked)
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
    solved = small_link(L, V, chain, arrivals=arrivals, depth=4, asked=asked)
    reached = 1 + weights @ run(solved.policy(), episodes, L, V).batch.senders["delivered_gain"]
    assert reached == pytest.approx(solved.value, abs=1e-9)
    best = weights @ [clairvoyant(each, L, V).qoi for each in episodes]
    for name in ("min-gap", "drop-oldest"):
        other = 1 + weights @ run(policies.get(name), episodes, L, V).batch.senders["delivered_gain"]
        assert other <= reached + 1e-9 <= best + 2e-9


def test_a_chain_draws_its_own_law():
    states = Chain(0.8).draw(20_000, np.random.default_rng(1))
    assert np.bincount(states) / len(states) == pytest.approx([0.25] * 4, abs=0.03)
    assert np.mean(states[1:] == states[:-1]) == pytest.approx(0.8, abs=0.01)


def test_what_it_can_not_solve_is_an_error():
    with pytest.raises(BufgymError, match="asked = 'never'"):
        small_link(1, V, Chain(), arrivals=2, asked="never")
    with pytest.raises(BufgymError, match="too many states"):
        small_link(9, V, Chain(), arrivals=2)
    with pytest.raises(BufgymError, match=r"stays = 2"):
        Chain(2)

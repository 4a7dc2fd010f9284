"""The planner: its programme against a search of every plan, its futures by hand, and where it leaves to a rule."""

import functools

import numpy as np
import pytest
from cases import newcomer, queue_of, same

from bufgym import policies
from bufgym.kernel import JIT, records
from bufgym.model import qoi
from bufgym.model.buffer import MESSAGE
from bufgym.model.link import Link as Uplink
from bufgym.policies import futures, hindsight
from bufgym.policies.futures import Grid, Link
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.traces import Trace

divide = getattr(hindsight.divide, "py_func", hindsight.divide)
kernels = pytest.mark.kernels
V = qoi.exponential(0.618)


def programme(rng, v, room, takes):
    """(x of all points, queued, L, grid, times at which the socket takes messages, table) of a random queue."""
    s, points = int(rng.integers(1, 5)), int(rng.integers(3, 9))
    L = s + room
    waits = s + min(room, 1)
    x, step_x = np.cumsum(rng.random(s + 2)), float(rng.random())
    slots, arrival, table = records(s, MESSAGE), newcomer(), divide(np.zeros(9_000), points, L)
    slots["x"], arrival["x"] = x[1:-1], x[-1]
    buffer, grid = queue_of(s, L)._replace(slots=slots, dequeued_x=x[0], v=v.array), Grid(points, 1.0)
    hindsight.prepare(buffer, arrival, step_x, grid, table)
    us = [0.0]
    for k in range(1, int(rng.integers(0, 2 * L + 1)) + 1):
        us.append(max(us[-1] + rng.exponential(0.7), float(k - waits)))
    us = [t for t in us if t <= points]
    table.dequeue_us[: len(us)] = us
    hindsight.sweep(s + 1, L, grid, len(us) - 1, table)
    hindsight.collect(s + 1, takes, table)
    return np.r_[x, x[-1] + step_x * np.arange(1, points + 1)], s, L, grid, us, table


def best_without(j, x, s, L, points, us, v, takes):
    """Every plan that lacks point j, tried: the k-th message sent is one that may be, behind the one before it."""
    taken, n = len(us) - 1, s + 1
    waits = min(n, L)
    end = us[-1] if taken == 2 * L else points

    def may_be(k, m):
        if m <= n:
            return k <= L
        last = min(int(us[k] if k <= taken else end), points)
        first = 1
        if k > waits:
            last = max(last, 1)
        if k > L:
            first = max(1, min(int(np.ceil(us[min(k - L, taken)])), last))
        return first <= m - n <= last

    @functools.cache
    def best(k, m):
        if k == taken + L:
            return 0.0
        idles = [best(k + 1, m)] if m >= n and (m == n or may_be(k + 1, m)) else []
        sent = [v(x[b] - x[m]) + best(k + 1, b) for b in range(m + 1, len(x)) if b != j and may_be(k + 1, b)]
        return max(sent + idles, default=hindsight.NOWHERE)

    if takes:  # the oldest that is kept goes before anything else is asked
        first = 2 if j == 1 else 1
        return v(x[first] - x[0]) + best(1, first)
    return best(0, 0)


@kernels
@pytest.mark.parametrize("takes", [False, True])
@pytest.mark.parametrize("room", [0, 1, 3])
@pytest.mark.parametrize("v", [qoi.exponential(0.5), qoi.saturating(1.3)])
def test_every_candidate_is_worth_what_a_search_of_all_plans_finds(v, room, takes):
    for seed in range(60):
        x, s, L, grid, us, table = programme(np.random.default_rng(seed), v, room, takes)
        for j in range(0 if room else 1, s + 2):
            assert table.without[j] == pytest.approx(best_without(j, x, s, L, grid.points, us, v, takes)), (seed, j)


@kernels
def test_the_expected_future_by_hand():
    # 1 byte/us now and in the long run, 10 bytes left, then messages of 20 bytes: at 10, 30, 50, ... us.
    us = np.zeros(9)
    assert futures.sample(Link(1.0, 0.0, 0.0, 10.0, 20.0, 8, 20.0), Grid(10, 10.0), 0, us) == 5
    assert us[1:6].tolist() == [10, 30, 50, 70, 90]
    # With room for one message and arrivals each 40 us the socket soon has nothing to take but what has just come.
    assert futures.sample(Link(1.0, 0.0, 0.0, 10.0, 20.0, 1, 40.0), Grid(10, 10.0), 0, us) == 3
    assert us[1:4].tolist() == [10, 40, 80]


@kernels
def test_futures_mirror_each_other():
    # A pair's rates have the same geometric mean as the expected ones: one is above where the other is below.
    link, grid, us = Link(1.0, 0.0, 0.0, 1e5, 1e5, 50, 1e5), Grid(50, 1e5), np.zeros((3, 101))
    taken = [futures.sample(link, grid, number, us[number]) for number in range(3)]
    assert min(taken[1:]) < taken[0] < max(taken[1:])


def episode(rates, seconds=20):
    """30 messages a second of 100 kB, over a link with these rates, a second each."""
    arrival_us = np.arange(30 * seconds) * 33_333
    trace = Trace.steps([(1.0, rate) for rate in rates], name="steps")
    return Episode(messages(arrival_us, np.full(len(arrival_us), 100_000)), Uplink(trace))


def test_it_keeps_more_than_afr_where_a_link_changes():
    episodes = [episode([1e6, 3e6, 0.5e6, 2e6, 0.7e6])]
    regret = {}
    for name in ("planner", "afr", "drop-oldest"):
        regret[name] = -float(run(policies.get(name), episodes, 8, V).batch.senders["delivered_gain"][0])
    assert regret["planner"] < regret["afr"] < regret["drop-oldest"]


@kernels
def test_a_few_futures_are_better_than_none():
    episodes = [episode([1e6], seconds=1)]
    planned, min_gap = (run(policies.get(name), episodes, 3, V) for name in ("planner:budget_us=1", "min-motion-gap"))
    assert planned.batch.senders["delivered_gain"][0] > min_gap.batch.senders["delivered_gain"][0]


@pytest.mark.skipif(not JIT, reason="its futures take compiled code")
def test_the_budget_is_one_of_work():
    # The same decisions again; with less work fewer futures, and other decisions.
    episodes = [episode([1e6, 3e6, 0.5e6, 2e6, 0.7e6])]
    runs = [run(policies.get(name), episodes, 8, V) for name in ("planner", "planner", "planner:budget_us=1")]
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


@kernels
def test_a_link_that_stands_still_is_left_to_min_motion_gap():
    # It never carries anything: there is no rate to plan with.
    still = Trace.steps([(1.0, 1.0)], name="still")
    arrivals = messages(np.arange(200) * 33_333, np.full(200, 100_000))
    episodes = [Episode(arrivals, Uplink(still))]
    assert same(*(run(policies.get(name), episodes, 5, V) for name in ("planner:standstill_s=0.01", "min-motion-gap")))


@pytest.mark.skipif(not JIT, reason="its futures take compiled code")
def test_it_drops_where_there_is_room():
    # A half, then a sixth of the demand: neighbours that are sent take the place of something farther on. The queue of
    # eight is full at 0.53 s at the earliest.
    episodes = [episode([1.5e6, 0.5e6])]
    runs = [run(policies.get(name), episodes, 8, V) for name in ("planner", "min-motion-gap")]
    gained = [float(each.batch.senders["delivered_gain"][0]) for each in runs]
    assert gained[0] > gained[1]
    log = runs[0].batch.log[0]
    dropped = np.sort(log["dropped_us"][log["dropped_us"] >= 0])
    assert len(dropped) and dropped[0] < 500_000

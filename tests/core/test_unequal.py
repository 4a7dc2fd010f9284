"""The programme for messages of unequal sizes, under prices, against a search of every plan."""

from functools import cache

import naive_oracle
import numpy as np
import pytest
from cases import VALUES, reference_messages, trace
from hypothesis import given
from hypothesis import strategies as st

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import UNLIMITED_BYTES
from bufgym.model.link import Link
from bufgym.oracle import clairvoyant, unequal
from bufgym.oracle.programme import Messages, Room, new_problem, waiting_cost
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.sim.metrics import outcome

pytestmark = pytest.mark.kernels
MESSAGE = st.tuples(st.integers(0, 30), st.integers(1, 12), st.integers(-1, 25), st.integers(0, 3), st.integers(0, 3))


@given(st.lists(MESSAGE, min_size=1, max_size=5), st.integers(10, 60), VALUES)
def test_the_best_plan_under_prices_is_that_of_a_search(messages, ends, v):
    """A message begins when the one before has ended, at the latest ``limit`` bytes after it arrived. It pays the
    price of every arrival that it waits through, its own too: so much, and so much more a byte."""
    c, size, limit, price, per_byte = np.array(sorted(messages)).T
    prices, x = np.array([price / 8, per_byte / 64]), np.arange(len(c)) * 1.5
    p = new_problem(Messages(c, size, limit, x, v.array, ends), np.full(len(c), -(10**6)), 10**6)
    assert p.grid == 1

    def cost(j, begin):
        waits = [k for k in range(j, len(c)) if c[k] < begin]
        return sum(prices[0, k] + size[j] * prices[1, k] for k in waits)

    def begins(j, end):
        """When message j begins after one that ends by then; None where that is too late."""
        begin = max(end, c[j])
        return begin if limit[j] >= 0 and begin <= c[j] + limit[j] and begin + size[j] <= ends else None

    @cache
    def best(i, end):
        found = [0.0]
        for j in range(i + 1, len(c)):
            if (begin := begins(j, end)) is not None:
                gain = v(x[j] - x[i]) if i >= 0 else 0.0
                found.append(gain - cost(j, begin) + best(j, begin + size[j]))
        return max(found)

    room = unequal.priced(p, prices, 1, 1)
    message, begin, queued = np.empty(len(c), np.int64), np.empty(len(c), np.int64), np.empty((2, len(c)))
    length, total = unequal.follow(p, room, message, begin)
    assert total == pytest.approx(best(-1, 0), abs=1e-12)
    assert length or all(begins(j, 0) is None for j in range(len(c)))  # a first message is worth the 1 in H
    ways, gain, end = message[:length].tolist(), 0.0, 0
    for k, j in enumerate(ways):
        assert begin[k] == begins(j, end)
        end = begin[k] + size[j]
        gain += (v(x[j] - x[ways[k - 1]]) if k else 0.0) - cost(j, begin[k])
    assert gain == pytest.approx(total, abs=1e-12)
    unequal.count_queued(p, message, begin, length, queued)
    for k in range(len(c)):
        waiting = [size[j] for j, at in zip(ways, begin[:length], strict=True) if j <= k and c[k] < at]
        assert queued[:, k].tolist() == [len(waiting), sum(waiting)]


@pytest.mark.parametrize("seed", range(60))
def test_no_plan_beats_the_bound_and_the_plan_found_keeps_to_its_room(seed):
    """Against a search of all decisions: short queues, by messages and by bytes, links that rest, scenes that stand."""
    rng = np.random.default_rng(seed)
    n, L, max_bytes = int(rng.integers(5, 9)), int(rng.integers(1, 4)), (None, 9_000, 14_000)[seed % 3]
    v = (qoi.exponential(0.4), qoi.saturating(2.5), qoi.tabulated([0, 1, 3], [0, 0.6, 1]))[seed // 3 % 3]
    us, size = np.cumsum(rng.choice([0, 300, 900, 2_000], n)), rng.integers(1, 8, n) * 1_201
    x = np.cumsum(rng.choice([0, 0.25, 1, 2.5], n))
    knots = [(0, 0), (4_000, int(rng.integers(2, 9)) * 1_500), (5_000 + 2_000 * (seed % 2), 12_000), (14_000, 24_000)]
    after = ("loop", "hold", "stop")[seed // 9 % 3]
    episode = Episode(messages(us, size, x), Link(trace(knots, after)))
    references = reference_messages(episode.arrivals)
    best = naive_oracle.best(naive_oracle.Link(knots, after, 0), references, L, v, max_bytes, "arrival", 0, n)
    plan = clairvoyant(episode, L, v, max_bytes=max_bytes)
    result = outcome(run(policies.get("clairvoyant"), [episode], L, v, max_bytes=max_bytes), 0)
    assert result.invalid == 0 and result.delivered == plan.kept.sum()
    assert result.qoi == pytest.approx(v.information(x[plan.kept]), abs=1e-9)
    assert result.qoi <= best + 1e-9 <= plan.qoi + 2e-9


def every_successor(p, room: Room, i: int, step: int) -> float:
    """The most that a plan under prices gains after message i that ends at this grid position: by trying them all."""
    most = 0.0
    for j in range(i + 1, len(p.c)):
        arrives = -(-p.c[j] // p.grid)
        begins, at = max(step, arrives), p.c[j] // p.grid
        if p.limit[j] < 0 or p.c[j] + p.size[j] > p.ends:
            continue
        if step < arrives:
            ends, cost = (p.c[j] + p.size[j]) // p.grid, 0.0
        elif begins <= min(p.c[j] + p.limit[j], p.ends - p.size[j]) // p.grid:
            ends, cost = begins + p.size[j] // p.grid, waiting_cost(p, room, j, begins)
        else:
            continue
        most = max(most, qoi.value(p.v, p.x[j] - p.x[i]) - cost + p.future[j, ends - at])
    return most


@given(st.integers(0, 2**32), VALUES)
def test_nothing_is_lost_by_looking_only_at_successors_that_can_still_be_best(seed, v):
    rng = np.random.default_rng(seed)
    n, grid = 24, int(rng.integers(2, 6))
    size, limit = rng.integers(1, 60, n), rng.choice([-1, 0, 30, 90, 150], n)
    c, x = np.cumsum(rng.integers(0, 25, n)), np.cumsum(rng.choice([0.0, 0.125, 0.5, 2.0], n))
    sent = Messages(c, size, limit, x, v.array, int(c[-1]) + 80)
    p = new_problem(sent, np.full(n, -(10**6)), int(size.mean()) // grid + 1)
    room = unequal.priced(p, rng.choice([0.0, 0.0, 0.02, 0.2], (2, n)) * [[1.0], [0.02]], n, 10**6)
    for i in np.flatnonzero((limit >= 0) & (c + size <= p.ends)):
        for step in range((c[i] + size[i]) // p.grid, min(c[i] + limit[i] + size[i], p.ends) // p.grid + 1):
            assert p.future[i, step - c[i] // p.grid] == pytest.approx(every_successor(p, room, i, step), abs=1e-12)


@given(st.integers(0, 2**32), VALUES)
def test_leaving_messages_out_while_the_link_is_idle_is_never_worth_it(seed, v):
    """Where waiting costs nothing, plans that never do so gain as much as all plans."""
    rng = np.random.default_rng(seed)
    n, x = 16, np.cumsum(rng.choice([0.0, 0.125, 0.5, 2.0], 16))
    c, size, limit = np.cumsum(rng.integers(0, 70, n)), rng.integers(1, 40, n), rng.choice([-1, 0, 20, 60], n)
    totals = []
    for certain in (limit, np.full(n, -(10**6))):
        p = new_problem(Messages(c, size, limit, x, v.array, int(c[-1]) + 30), certain, 10**6)
        room = unequal.priced(p, np.zeros((2, n)), n, 10**6)
        totals.append(unequal.follow(p, room, np.empty(n, np.int64), np.empty(n, np.int64))[1])
    assert totals[0] == pytest.approx(totals[1], abs=1e-12)


def test_a_fast_link_costs_no_work_where_no_message_reaches():
    """Three bursts, 10**8 bytes apart, of which the last comes when the link has ended: plan and bound stay."""
    size, limit, x = np.random.default_rng(7).integers(100, 900, 30), np.full(30, 2_000), np.arange(30) / 4
    c = np.repeat([500, 10**8, 2 * 10**8], 10) + np.tile(np.arange(10) * 90, 3)
    sent = Messages(c, size, limit, x, qoi.exponential(0.5).array, 10**8 + 5_000)
    short, *_, ends = unequal.without_idle(sent, 96)
    assert (np.diff(short)[[9, 19]] < 4_000).all() and (np.diff(short)[:9] == 90).all()
    assert short[0] == 500 and ends - short[10] in (5_000, short[20] - short[10])
    plan, bound = unequal.best(sent, np.full(30, 100), 3, UNLIMITED_BYTES)
    assert 0 < len(plan) < 20 and plan.max() < 20
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unequal, "without_idle", lambda messages, step: messages)
        again, same = unequal.best(sent, np.full(30, 100), 3, UNLIMITED_BYTES)
    assert again.tolist() == plan.tolist() and same == bound

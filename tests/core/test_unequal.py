"""The programme for messages of unequal sizes, under prices, against a search of every plan."""

from functools import cache

import numpy as np
import pytest
from cases import VALUES
from hypothesis import given
from hypothesis import strategies as st

from bufgym.oracle import unequal
from bufgym.oracle.programme import new_problem

pytestmark = pytest.mark.kernels
MESSAGE = st.tuples(st.integers(0, 30), st.integers(1, 12), st.integers(-1, 25), st.integers(0, 3), st.integers(0, 3))


@given(st.lists(MESSAGE, min_size=1, max_size=5), st.integers(10, 60), VALUES)
def test_the_best_plan_under_prices_is_that_of_a_search(messages, ends, v):
    """A message begins when the one before has ended, at the latest ``limit`` bytes after it arrived. It pays the
    price of every arrival that it waits through, its own too: so much, and so much more a byte."""
    c, size, limit, price, per_byte = np.array(sorted(messages)).T
    prices, x = np.array([price / 8, per_byte / 64]), np.arange(len(c)) * 1.5
    p = new_problem(c, size, limit, np.full(len(c), -(10**6)), x, v.array, ends, 10**6)
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

    room = unequal._priced(p, prices, 1, 1)
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

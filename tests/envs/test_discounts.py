"""What a discount does to the rewards ``delivered`` and ``retained``: every sequence of actions on a small link.

``retained`` is ``delivered`` + F(after) - F(before), where F is the QoI held. The sums of both are H - 1. With a
discount g, ``retained`` also pays (1 - g) F in every step: it pays for a full queue. ``retained`` - (1 - g) F is
``delivered`` + g F(after) - F(before), which changes no best policy (Ng, Harada and Russell 1999).
"""

from itertools import product
from typing import Any

import numpy as np
import pytest

from bufgym.envs.options import Options
from bufgym.envs.rows import Rows
from bufgym.model import qoi
from bufgym.scenario import Uplink
from bufgym.scenario.numbered import draw
from bufgym.traces import Trace

L, FRAMES = 2, 6
LINK = Trace.steps([(0.15, 9_000), (0.05, 3_000), (0.05, 1_500), (0.15, 500), (0.15, 0), (0.05, 9_000), (0.2, 4_000)])
SCENARIO = Uplink(traces=(LINK,), rate_hz=10, duration_s=FRAMES / 10, size_bytes=900, value=qoi.exponential(0.5))


@pytest.fixture(scope="module")
def played() -> tuple[Any, Any, Any]:
    """Delivered and retained rewards and the QoI held afterwards, float64[sequences, steps], of all sequences."""
    sequences = np.array(list(product(range(L + 2), repeat=FRAMES)))
    rows = Rows(len(sequences), SCENARIO, Options(capacity=L))
    rows.reset(np.arange(len(rows)), [draw(SCENARIO, 0)] * len(rows))
    rewards, held = [], []
    for actions in sequences.T:
        rows.step(np.ascontiguousarray(actions))
        rewards.append(rows.output.reward_terms[:, :2].copy())
        held.append(rows.rewarded[:, 1] - rows.rewarded[:, 0])
    assert rows.output.terminated.all()
    delivered, retained = np.stack(rewards, axis=1).transpose(2, 0, 1)
    return delivered, retained, np.stack(held, axis=1)


def returns(rewards: Any, gamma: float) -> Any:
    """The discounted sum of each sequence."""
    return rewards @ gamma ** np.arange(rewards.shape[1])


def best(rewards: Any, gamma: float) -> set[int]:
    """The sequences with the largest return."""
    found = returns(rewards, gamma)
    return set(np.flatnonzero(found > found.max() - 1e-9).tolist())


def test_without_a_discount_both_sum_to_the_same(played: Any) -> None:
    delivered, retained, held = played
    assert returns(retained, 1.0) == pytest.approx(returns(delivered, 1.0), abs=1e-12)
    assert (held >= -1e-12).all() and held[:, -1] == pytest.approx(0.0, abs=1e-12)
    assert np.ptp(returns(delivered, 1.0)) > 0.5  # the sequences differ


@pytest.mark.parametrize("gamma", [0.5, 0.9])
def test_with_a_discount_retained_pays_for_what_is_held(played: Any, gamma: float) -> None:
    delivered, retained, held = played
    excess = returns(retained, gamma) - returns(delivered, gamma)
    assert excess == pytest.approx((1 - gamma) * returns(held, gamma), abs=1e-12)
    assert excess.max() > 0.1


@pytest.mark.parametrize("gamma", [0.3, 0.5, 0.9, 1.0])
def test_less_what_it_pays_the_best_sequences_are_those_of_delivered(played: Any, gamma: float) -> None:
    delivered, retained, held = played
    shaped = retained - (1 - gamma) * held
    assert returns(shaped, gamma) == pytest.approx(returns(delivered, gamma), abs=1e-12)
    assert best(shaped, gamma) == best(delivered, gamma)


def test_but_they_need_not_be_the_best_without_a_discount(played: Any) -> None:
    """An early delivery is worth more than a good one then: a quarter of a message is lost. ``retained`` loses none."""
    delivered, retained, _ = played
    total = returns(delivered, 1.0)
    assert max(total[list(best(delivered, 0.3))]) == pytest.approx(total.max() - 0.25)
    assert max(total[list(best(retained, 0.3))]) == pytest.approx(total.max())

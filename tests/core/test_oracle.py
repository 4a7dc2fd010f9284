"""Optima: the oracle of one interruption, and what it checks."""

import math
from itertools import combinations

import numpy as np
import pytest
from cases import VALUES
from hypothesis import given
from hypothesis import strategies as st
from refusal_cases import refuse

from bufgym import policies
from bufgym.ground.errors import BufgymError
from bufgym.model import qoi
from bufgym.oracle import by_length, ideal, integer
from bufgym.scenario import Interruption, Streams, registry
from bufgym.sim import run

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
def test_one_run_tells_of_every_shorter_interruption():
    """Messages 1, 2, 3 arrive, L = 1: the second evicts the first, the third is rejected; message 4 follows."""
    v = qoi.exponential(0.5)
    # T = 0: 0, 1. T = 1: 0, 1, 2. T = 2: 0, 2, 3. T = 3: 0, 2, 4.
    assert by_length(np.array([9, 2, 9, 3, 9]), v).tolist() == [1 + v(1), 1 + 2 * v(1), 1 + v(2) + v(1), 1 + 2 * v(2)]


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
            refuse(f"oracle: L = {L}, T = {T}: need L >= 1 and T >= 0", truth, L, T, qoi.exponential())

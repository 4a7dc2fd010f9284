"""Guided decisions: outputs that change the numbers of the one rule, and the inputs that an agent may look at."""

from dataclasses import replace

import numpy as np
import pytest
from cases import VALUES, cases, same
from hypothesis import given
from hypothesis import strategies as st
from test_price_dp import equal

from bufgym import policies
from bufgym.policies import guided
from bufgym.policies.guided import INPUTS, OUTPUTS

kernels = pytest.mark.kernels
ZERO = np.zeros((len(OUTPUTS), len(INPUTS)))


@kernels
@given(cases(max_messages=25), VALUES, st.booleans())
def test_without_weights_it_is_gap_price(case, v, equals):
    case = equal(case) if equals else case
    assert same(case.run(guided.linear("zero", ZERO), v), case.run(policies.get("gap-price"), v))


@kernels
@given(cases(max_messages=25), VALUES, st.integers(0, 2**32))
def test_weights_decide_the_same_compiled_or_not(case, v, seed):
    policy = guided.linear("some", np.random.default_rng(seed).normal(0, 0.3, ZERO.shape))
    assert same(case.run(policy, v), case.run(replace(policy, compile=False), v))

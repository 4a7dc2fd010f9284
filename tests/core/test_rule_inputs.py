"""What gap-price knows, as numbers that a network looks at."""

import numpy as np
import pytest
from test_price_dp import queue

from bufgym.policies import price_dp, rule_inputs, target_gap
from bufgym.policies.rule_inputs import INPUTS

kernels = pytest.mark.kernels


@kernels
def test_inputs_are_what_the_rule_knows():
    """One message a second of 100 bytes, V = 1 - 2^-d, a link of 50 bytes/s; the head waits since one second."""
    buffer, arrival = queue((9.0, 100), now=10.0, sent=7.0, now_bytes=300, stalled_us=2_000_000)
    rates = {"short_rate_bytes_per_s": 100.0, "medium_rate_bytes_per_s": 25.0, "long_rate_bytes_per_s": 50.0}
    buffer = buffer._replace(period_us=1e6, dequeued_arrival_us=0, **rates)
    buffer.slots["arrival_us"][0], arrival["arrival_us"] = 9_000_000, 10_000_000
    memory = np.zeros(len(rule_inputs.REMEMBERED))
    memory[rule_inputs.LOG_RATE_VARIANCE] = 0.25
    memory[rule_inputs.RULE + target_gap.RATE] = 50e-6
    memory[rule_inputs.RULE + price_dp.VARIANCE] = 0.01
    seen = np.zeros(len(INPUTS))
    rule_inputs.inputs(buffer, arrival, memory, rule_inputs.BASE, seen)
    size, s, r, g = 200.0, 1, (0.25 * 100 + 0.25 * 50 + 0.5 * 50) / 1e6, 3.0 / 2
    by_hand = {
        "short": np.log(2),
        "medium": -np.log(2),
        "load": np.log(r * 1e6 / size),
        "bend": 2 * (2 * (1 - 2**-g) - (1 - 2 ** (-2 * g))) / (1 - 2**-g) - 1,
        "spread": -0.2,
        "head_age": np.log((r * 1e6 + 0.1 * size) / (size * (s + 1))),
        "newcomer": 0.0,
        "stall": np.log(1 + 2e6 * r / size) - 0.5,
        "size_spread": 0.2,
        "bytes": np.log(1.5),
        "fill": 2 * s / 8 - 1,
        "unknown": 1.0,
        "one": 1.0,
        "head_gap": np.log(3.0 / g),
        "share": 1 / (1 + np.exp(5 - 6)),
        "plain": 0.0,
    }
    assert dict(zip(INPUTS, seen, strict=True)) == pytest.approx(by_hand)


@kernels
@pytest.mark.parametrize(("a", "b", "ratio"), [(np.e, 1, 1), (1e9, 1, 3), (0, 1, -3), (1, 0, 3), (0, 0, 0), (-1, 0, 0)])
def test_a_ratio_is_never_endless(a, b, ratio):
    assert rule_inputs.lg(float(a), float(b)) == pytest.approx(ratio)

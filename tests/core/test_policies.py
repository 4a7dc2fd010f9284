"""Drop policies by hand, their settings and their sources. (Each decision of theirs: ``test_policy_registry``.)"""

import pytest
from cases import VALUES, cases, same
from hypothesis import given
from policy_cases import kept, worst_ratio

from bufgym import policies

MS = 1_000
kernels = pytest.mark.kernels


def test_worst_gaps():
    # The first eviction at L = 8 leaves one gap of 2 where 10/9 would be ideal: 1.8 for whoever drops at all.
    assert worst_ratio("min-gap", 8, [9]) == pytest.approx(1.8)
    assert worst_ratio("min-gap", 8, range(8, 300)) == pytest.approx(1.80, abs=0.005)
    # AFR's tends to 2 as T grows, that of times which grow as powers to the paper's 1.59, both for large L.
    assert 1.9 < worst_ratio("afr", 8, range(8, 600)) < 2
    assert worst_ratio("afr", 32, range(512, 1_500, 5)) == pytest.approx(2, abs=0.01)
    assert worst_ratio("linear-alpha", 32, range(512, 1_500, 5)) == pytest.approx(1.59, abs=0.07)


@kernels
@given(cases(), VALUES)
def test_linear_with_alpha_1_is_afr(case, v):
    assert same(case.run(policies.get("linear-alpha:alpha=1"), v), case.run(policies.get("afr"), v))


@kernels
@pytest.mark.parametrize(
    ("spec", "L", "T", "expected"),
    [
        # So after 1..4 alpha = 2 keeps arrivals 4 + 2.25, 5, 8.25, 12, each at the first whole number: 7, 9, 13, 16.
        # Evicted are 1, 3, then 7 (the third of 2 4 7 9) and 13; the next is due at 16 + 9.
        ("linear-alpha:alpha=2", 4, 16, [2, 4, 9, 16]),
        ("linear-alpha:alpha=2", 4, 25, [4, 9, 16, 25]),
        # S = 8: four of 1, 2, 4, ...; two of 3, 6, 12, ...; one each of 5, 10, ... and 7, 14, ...
        ("steady", 8, 12, [1, 2, 4, 6, 7, 8, 10, 12]),
        ("steady", 8, 16, [2, 4, 6, 8, 10, 12, 14, 16]),
        ("steady", 8, 32, [4, 8, 12, 16, 20, 24, 28, 32]),
        ("steady", 15, 16, [2, 4, 6, 8, 10, 12, 14, 16]),  # L = 15 has the 8 sites of L = 8
        ("steady", 1, 63, [32]),  # one site keeps powers of two
        # The socket took message 0. At 4: T = 4, beta T / (L + 1) = 1.3: message 4 is 1 from 3, rejected. At 5: 2
        # against 1.625, so 5 enters and 1 goes (merged gaps 2, 2, 3). beta = 0.9: 1 against 0.9: 4 enters.
        ("even-reject", 3, 4, [1, 2, 3]),
        ("even-reject", 3, 5, [2, 3, 5]),
        ("even-reject:beta=0.9", 3, 4, [2, 3, 4]),
        # x is the frame index. The even spacing at T is T / 4, of which 0.7 count; slots 0, 1, 2 count 0.65, 0.767,
        # 0.883. At 4: 1 against 0.7, and of the gaps 2, 2, 2 the oldest is the least: 1 goes. At 5: 1 against 0.875;
        # gaps 3, 2, 2 count 1.95, 1.53, 1.77: 3 goes. At 6: 1 against 1.05: rejected. At 7: 2 against 1.225; gaps 4, 3,
        # 3 count 2.6, 2.3, 2.65: 4 goes.
        ("paced-motion-gap", 3, 6, [2, 4, 5]),
        ("paced-motion-gap", 3, 7, [2, 5, 7]),
        ("paced-motion-gap:discount=0.01", 3, 5, [2, 4, 5]),
        ("paced-motion-gap:pace=0.9", 3, 5, [2, 3, 4]),
        ("ros-keep-last", 16, 30, [*range(21, 31)]),  # 10 by default
        ("latest-only", 16, 30, [30]),
        # Message 0 was the first of three; 1 and 2 are decimated, as are 4 and 5.
        ("decimate", 3, 6, [1, 4]),
        # 4 drops 1 (of equal gaps the oldest), 5 drops 3, 6 drops 5: the gaps stay 2.
        ("min-gap", 3, 6, [2, 4, 6]),
        # Message 0 left last. 4 drops 1 (between 0 and 2; of equals the first); 5 drops 3: 2 4 5; 6 drops 4.
        ("orbbuf", 3, 6, [2, 5, 6]),
    ],
)
def test_what_is_kept(spec, L, T, expected):
    assert kept(spec, L, T) == expected


@pytest.mark.parametrize(("name", "default"), [("lifespan", {"lifespan_s": 0.5}), ("keyframe", {"step": 0.05})])
def test_settings_by_default(name, default):
    assert dict(policies.get(name).parameters) == default

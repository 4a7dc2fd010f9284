"""Drop policies by hand, their settings and their sources. (Each decision of theirs: ``test_policy_registry``.)"""

import re
from pathlib import Path

import numpy as np
import pytest
from cases import VALUES, cases, log, newcomer, order, queue_of, same
from hypothesis import given
from policy_cases import kept, stream, worst_ratio

from bufgym import policies
from bufgym.policies import ACCEPT, REJECT, afr

MS = 1_000
kernels = pytest.mark.kernels


def ask(on_arrival, L, s, r, c, p):
    """The decision with s of L messages queued, and the memory after it."""
    memory = np.array([r, c, p], np.float64)
    return on_arrival(queue_of(s, L), newcomer(), memory), *memory


@kernels
def test_the_bound_for_halving():
    # s/L = 2/3 exactly: the code halves r, so the newcomer is accepted; the text does not, so it is counted out.
    assert ask(afr.afr, 3, 2, r=2, c=0, p=1) == (ACCEPT, 1, 0, 1)
    assert ask(afr.afr_paper, 3, 2, r=2, c=0, p=1) == (REJECT, 2, 1, 1)
    # Below it both do, once an arrival, with c reduced: r = 8 -> 4, c = 7 -> 3, which is counted up to 4.
    for on_arrival in (afr.afr, afr.afr_paper):
        assert ask(on_arrival, 3, 1, r=8, c=7, p=0) == (ACCEPT, 4, 0, 0)
        assert ask(on_arrival, 3, 3, r=1, c=0, p=2) == (2, 2, 0, 0)  # the end of a pass


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


@kernels
def test_least_distances():
    # 10 Hz at most: of 100 frames/s every tenth; of camera frames every fourth, for three periods are 99.999 ms.
    assert order(stream("time-filter", 50, 10_000, 4)) == list(range(0, 50, 10))
    assert order(stream("time-filter", 20, 33_333, 4)) == list(range(0, 20, 4))
    # The camera moves 0.02 a frame: every third frame is 0.06 >= 0.05 on. Standing still, none is.
    assert order(stream("keyframe", 20, 10_000, 4, x=np.arange(20) * 0.02)) == list(range(0, 20, 3))
    assert order(stream("keyframe", 20, 10_000, 4, x=np.zeros(20))) == [0]


@kernels
def test_foxglove_backlog():
    # 0.3 MB a message, nothing leaves: one in transmission (all of it unsent) and 32 queued make 9.9 MB; one more would
    # reach 10.2 MB. With 0.4 MB: 1 + 23 make 9.6, the 25th would reach 10.0 exactly: dropped.
    for size_bytes, accepted in ((300_000, 33), (400_000, 24)):
        senders = stream("foxglove-backlog", 60, 1, 100, size_bytes=size_bytes, bytes_per_s=1.0)
        assert len(log(senders)["dropped_us"]) == 60 - accepted
    assert len(log(stream("foxglove-backlog", 60, 1, 8, bytes_per_s=1.0))["dropped_us"]) == 60 - 9  # L


@kernels
def test_codel_drops_ever_faster():
    # Two messages arrive for each that leaves: the one taken at k ms is k/2 ms old. At 10 ms that is the target of 5;
    # an interval later, at 110 ms, the first is dropped; from there on the gaps are 100 ms / sqrt(count).
    times_ms = sorted(us / MS for us in log(stream("codel", 600, 500, 1_000))["dropped_us"].values())[:3]
    exact = 110 + np.cumsum([0, *(100 / np.sqrt(np.arange(1, 3)))])
    assert exact == pytest.approx([110, 210, 280.7], abs=0.05)
    assert times_ms == np.ceil(exact).tolist()  # the socket takes a message each ms


@pytest.mark.parametrize(("name", "default"), [("lifespan", {"lifespan_s": 0.5}), ("keyframe", {"step": 0.05})])
def test_settings_by_default(name, default):
    assert dict(policies.get(name).parameters) == default


ROOT = Path(__file__).parents[2]
KEYS = set(re.findall(r"^@\w+\{(\w+),", (ROOT / "docs/references.bib").read_text(encoding="utf-8"), re.M))


def test_keys_in_brackets_are_references():
    for path in sorted((ROOT / "bufgym").rglob("*.py")):
        assert set(re.findall(r"\[([a-z]+(?:19|20)\d\d[a-z0-9]*)\]", path.read_text(encoding="utf-8"))) <= KEYS, path


@pytest.mark.parametrize("name", [*policies.names()])
def test_a_source_that_is_a_paper_has_its_key(name):
    source = policies.get(name).source
    if re.search(r"paper|et al\.|RFC|\b(19|20)\d\d\b|AFR \[|ORBBuf|Robofleet", source):
        assert set(re.findall(r"\[(\w+)\]", source)) & KEYS, source

"""Drop policies by hand: AFR's figures step by step, what chance may do, what each paper or program says it does."""

import re
from pathlib import Path

import numpy as np
import pytest
from cases import VALUES, cases, log, newcomer, order, queue_of, same
from hypothesis import given
from policy_cases import V, drops, interruption, kept, stream, worst_ratio

from bufgym import policies
from bufgym.model.link import Link
from bufgym.policies import ACCEPT, REJECT, afr
from bufgym.scenario import Episode, Interruption, messages
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace

MS = 1_000
kernels = pytest.mark.kernels


@kernels
@pytest.mark.parametrize("name", ["afr", "afr-paper"])
def test_figure_4(name):
    # L = 8. Arrivals 9 .. 16 drop 1, 3, ..., 15: every second message is left and the rate is halved (r = 2, p = 0).
    # The counter rejects 17; 18 drops 2.
    evens = [(arrival, 2 * arrival - 17) for arrival in range(9, 17)]
    assert drops(interruption(name, 8, 18)) == [*evens, (17, 17), (18, 2)]
    assert kept(name, 8, 16) == [2, 4, 6, 8, 10, 12, 14, 16]


@kernels
def test_more_time_may_show_less():
    # H - 1 at L = 8: at T = 35 the queue holds an even 4, 8, ..., 32; at T = 36 message 4 goes.
    gains = [outcome(interruption("afr", 8, T), 0).qoi - 1 for T in (35, 36)]
    assert gains == pytest.approx([7.687, 7.340], abs=5e-4)
    assert [kept("afr", 8, T) for T in (35, 36)] == [[*range(4, 33, 4)], [*range(8, 37, 4)]]


@kernels
@pytest.mark.parametrize("T", [1, 2, 3, 4, 7, 8, 63, 64])
def test_one_place_keeps_powers_of_two(T):
    assert kept("afr", 1, T) == kept("afr-paper", 1, T) == [2 ** (T.bit_length() - 1)]


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


L, T, RUNS = 4, 12, 3_000


@pytest.mark.parametrize(
    ("name", "decide_at", "expected"),
    [
        # Equation 9: P{i is kept} = (L / (L + 1))^min(T - i + 1, T - L), 0.8^8 for the first five, 0.8 for the last.
        ("random", "arrival", np.array([0.8 ** min(T - i + 1, T - L) for i in range(1, T + 1)])),
        ("reservoir", "arrival", np.full(T, L / T)),
        ("reservoir", "overflow", np.full(T, L / T)),
    ],
)
def test_how_often_chance_keeps_each_message(name, decide_at, expected):
    rng = np.random.default_rng(7)
    episodes = [Interruption(t_max=T).episode(T).with_uniforms(rng) for _ in range(RUNS)]
    senders = run(policies.get(name), episodes, L, V, decide_at=decide_at)
    share = (np.asarray(senders.batch.log)["transmitted_us"] >= 0)[:, 1 : T + 1].mean(0)
    assert (np.abs(share - expected) < 4.5 * np.sqrt(expected * (1 - expected) / RUNS)).all()


def test_worst_gaps():
    # The first eviction at L = 8 leaves one gap of 2 where 10/9 would be ideal: 1.8 for whoever drops at all.
    assert worst_ratio("min-gap", 8, [9]) == pytest.approx(1.8)
    assert worst_ratio("min-gap", 8, range(8, 300)) == pytest.approx(1.80, abs=0.005)
    # AFR's tends to 2 as T grows, that of times which grow as powers to the paper's 1.59, both for large L.
    assert 1.9 < worst_ratio("afr", 8, range(8, 600)) < 2
    assert worst_ratio("afr", 32, range(512, 1_500, 5)) == pytest.approx(2, abs=0.01)
    assert worst_ratio("linear-alpha", 32, range(512, 1_500, 5)) == pytest.approx(1.59, abs=0.07)


@kernels
@pytest.mark.parametrize(("every", "accepted"), [(2, [0, 2, 4, 6, 8]), (2.5, [0, 3, 5, 8]), (1, list(range(10)))])
def test_decimate_keeps_one_in_every(every, accepted):
    """An open link sends whatever is accepted; one in 2.5 alternates between steps of 3 and 2."""
    assert order(stream(f"decimate:every={every}", 10, 1_000_000, 4, size_bytes=1)) == accepted


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
def test_greedy_is_a_trap():
    # It thins evenly until the gaps are 2. Then a merger costs V(1) - (2 V(2) - V(4)) = 0, and the tail V(3) - V(2) is
    # gained by replacing it: 2, 4, ..., 14 stay, and only the newest changes. H grows by V(T - 14) <= 1 at most.
    for T in (16, 17, 40):
        assert kept("greedy-qoi", 8, T) == [2, 4, 6, 8, 10, 12, 14, T]
    greedy, afr = (outcome(interruption(name, 8, 40), 0).qoi for name in ("greedy-qoi", "afr"))
    assert greedy == pytest.approx(1 + 7 * V(2) + V(26) + V(1), abs=1e-12) and greedy < afr - 0.14


@kernels
@pytest.mark.parametrize(("lifespan_s", "dropped"), [(0.499999, 1), (0.5, 0), (0.500001, 0)])
def test_lifespan(lifespan_s, dropped):
    # The second message waits until the first is transmitted, at 0.5 s. Exactly 0.5 s old is not too old.
    episode = Episode(messages(np.array([0, 0]), 500_000), Link(Trace.constant(1e6, 20)))
    assert len(log(run(policies.get(f"lifespan:lifespan_s={lifespan_s}"), [episode], 4, V))["dropped_us"]) == dropped


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

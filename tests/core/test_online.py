"""The optima of one interruption, with and without knowing T: against brute force, against every policy, and played."""

import math
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from cases import VALUES, order, same
from hypothesis import given
from hypothesis import strategies as st
from refusal_cases import refuse

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.oracle import law, online_optimum
from bufgym.oracle.interruption import by_length, ideal, integer
from bufgym.oracle.online import OnlineOptimum
from bufgym.policies import ACCEPT, REJECT, Policy
from bufgym.scenario import Episode, Interruption, Streams, messages, registry
from bufgym.sim import run
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

kernels = pytest.mark.kernels
V = qoi.exponential(0.618)


def uniform(L: int, t_max: int) -> np.ndarray:
    """T uniform on L + 1..t_max."""
    return law(Interruption(law="uniform", t_min=L + 1, t_max=t_max))


def means(policy: Policy, L: int, probabilities: np.ndarray, v: qoi.Value = V) -> dict[str, float]:
    """What the simulator makes of a policy: the mean over T of both objectives (message 0 is not counted).

    Luck is the same whatever T is, so a randomised policy too is one deterministic policy that does not know T.
    """
    scenario = Interruption(t_max=len(probabilities) - 1)
    lengths = np.flatnonzero(probabilities)
    episodes = [scenario.episode(int(T)).with_uniforms(np.random.default_rng(7)) for T in lengths]
    gained = np.asarray(run(policy, episodes, L, v).batch.senders["delivered_gain"])
    best = np.array([integer(L, int(T), v) for T in lengths])
    p = probabilities[lengths]
    return {"ratio": float(p @ (gained / best)), "qoi": float(p @ gained)}


@kernels
def test_laws_by_hand():
    assert law(Interruption("fixed", t_max=3)).tolist() == [0, 0, 0, 1]
    assert law(Interruption("uniform", t_min=2, t_max=5)).tolist() == [0, 0, 0.25, 0.25, 0.25, 0.25]
    assert law(Interruption("uniform", t_min=1, t_max=4, lengths=(1, 2))).tolist() == [0, 0.5, 0.5, 0, 0]
    # Weights ln((T + 1) / T) over T = 1, 2, 3 add up to ln 4.
    assert law(Interruption("log-uniform", t_max=3)) == pytest.approx(np.log([1, 2, 1.5, 4 / 3]) / np.log(4))
    # Mean 4 from 2 on: it ends with probability 1/3 each period; at 4 it is cut off.
    assert law(Interruption("geometric", t_min=2, t_max=4, t_mean=4)) == pytest.approx([0, 0, 1 / 3, 2 / 9, 4 / 9])
    assert law(Interruption("geometric", t_min=2, t_max=4, t_mean=2)).tolist() == [0, 0, 1, 0, 0]


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("fixed", {"t_max": 9}),
        ("uniform", {"t_min": 3, "t_max": 9}),
        ("log-uniform", {"t_min": 2, "t_max": 30}),
        ("geometric", {"t_min": 2, "t_max": 20, "t_mean": 9}),
    ],
)
def test_laws_are_those_that_lengths_are_drawn_from(name, parameters):
    scenario, n, rng = Interruption(name, **parameters), 20_000, np.random.default_rng(1)
    p = law(scenario)
    drawn = np.bincount([scenario.draw_length(rng) for _ in range(n)], minlength=len(p)) / n
    assert math.fsum(p) == pytest.approx(1, abs=1e-12)
    assert (np.abs(drawn - p) <= 4.5 * np.sqrt(p * (1 - p) / n)).all()


def all_policies(L: int, p: list[float], v: qoi.Value, objective: str, kept: tuple[int, ...] = (), t: int = 0) -> float:
    """The best over every way to decide from t arrivals on, with ``kept`` in the queue.

    All that a policy learns is that another message has come: without luck it is one fixed sequence of decisions. This
    tries every sequence, also those that reject or evict where there is room.
    """
    gains = [v(b - a) for a, b in zip((0, *kept), (*kept, t + 1), strict=True)]
    now = p[t] * math.fsum(gains) / (integer(L, t, v) if objective == "ratio" else 1)
    if t + 1 == len(p):
        return now
    return now + max(all_policies(L, p, v, objective, after, t + 1) for after in choices(L, kept, t + 1))


def choices(L: int, kept: tuple[int, ...], t: int) -> set[tuple[int, ...]]:
    """What can be in the queue once message t has been decided on."""
    evicting = {(*kept[:k], *kept[k + 1 :], t) for k in range(len(kept))}
    return {kept, *evicting, *({(*kept, t)} if len(kept) < L else ())}


@kernels
@pytest.mark.parametrize("objective", ["ratio", "qoi"])
@given(v=VALUES, L=st.integers(1, 3), weights=st.lists(st.integers(0, 5), min_size=1, max_size=6).filter(any))
def test_is_the_best_of_all_policies(objective, v, L, weights):
    p = [w / sum(weights) for w in weights]
    best = all_policies(L, p, v, objective)
    assert online_optimum(L, p, v, objective=objective).value == pytest.approx(best, abs=1e-12)


@kernels
@given(VALUES, st.integers(1, 3), st.lists(st.integers(0, 5), min_size=2, max_size=7).filter(lambda w: w[-1] > 0))
def test_decides_for_the_best_in_every_state(v, L, weights):
    """In those as well that its own decisions never lead to."""
    p = [w / sum(weights) for w in weights]
    made = online_optimum(L, p, v)
    for t in range(1, len(p)):
        for kept in (kept for s in range(min(L, t - 1) + 1) for kept in combinations(range(1, t), s)):
            k = made.decision([*kept, t])
            after = kept if k == REJECT else (*kept, t) if k == ACCEPT else (*kept[:k], *kept[k + 1 :], t)
            best = max(all_policies(L, p, v, "ratio", others, t) for others in choices(L, kept, t))
            assert all_policies(L, p, v, "ratio", after, t) == pytest.approx(best, abs=1e-12)


SCENARIOS = [
    (1, uniform(1, 30), "ratio"),
    (2, law(Interruption("log-uniform", t_max=16)), "qoi"),
    (3, law(Interruption("geometric", t_max=14, t_mean=8)), "ratio"),
]


@pytest.mark.parametrize(("L", "p", "objective"), SCENARIOS)
def test_no_policy_beats_it_and_it_plays_as_it_promises(L, p, objective):
    made = online_optimum(L, p, V, objective=objective)
    assert made.value <= (1 if objective == "ratio" else integer(L, made.t_max, V))
    for policy in map(policies.get, policies.names()):
        # Those that keep more than L messages or know T beforehand are no match for it.
        assert not policy.ranked or means(policy, L, p)[objective] <= made.value + 1e-12, policy.name
    assert means(made.policy(), L, p)[objective] == pytest.approx(made.value, abs=1e-12)


@pytest.fixture(scope="module")
def made() -> OnlineOptimum:
    return online_optimum(3, uniform(3, 16), V)


@kernels
def test_a_link_that_stops_in_mid_stream_is_an_interruption_from_there_on(made):
    T, n = 14, 5
    # Messages 0..4 cross at once; from 45 ms on nothing does, so message 5 is in transmission for the outage.
    trace = Trace.steps([(0.045, 10**6), (0.01 * T + 0.01, 0), (1.0, 10**6)], name="outage")
    stopped = run(made.policy(), [Episode(messages(np.arange(n + T + 2) * 10_000, 1), Link(trace))], 3, V)
    plain = run(made.policy(), [Interruption(t_max=T).episode(T)], 3, V)
    assert order(stopped) == [*range(n), *(n + k for k in order(plain))]


def test_what_the_table_lacks_is_left_to_min_gap(made):
    min_gap = policies.get("min-gap")
    late = [Interruption(t_max=40).episode(T) for T in (4, 16, 17, 40)]
    # A law that ends at T = L never told it what to drop.
    assert same(run(online_optimum(3, [0, 0, 0, 1], V).policy(), late, 3, V), run(min_gap, late, 3, V))
    # Up to t_max the table decides.
    assert not same(run(made.policy(), late[:2], 3, V), run(min_gap, late[:2], 3, V))
    # All at one time, so without a period; and two in each.
    trace = Trace.steps([(0.001, 0), (1.0, 1)], name="blocked")
    at_once = Episode(messages(np.zeros(12, np.int64), 10), Link(trace))
    assert same(run(made.policy(), [at_once], 3, V), run(min_gap, [at_once], 3, V))
    pairs = Episode(messages(np.repeat(np.arange(8), 2) * 10_000, 10), Link(trace))
    assert run(made.policy(), [pairs], 3, V).batch.senders["invalid"][0] == 0


@kernels
def test_decisions(made):
    assert made.t_max == 16
    assert made.decision([1]) == made.decision([2, 9, 16]) == ACCEPT
    # A newcomer that leaves three slots crowded at one end: one of the crowd goes.
    assert made.decision([1, 2, 3, 16]) in (0, 1, 2)
    assert made.policy().name == "online-optimum:L=3"
    for positions in ([], [0, 1], [3, 3], [4, 2], [2, 17], [1, 2, 3, 4, 5]):
        refuse("must be 1 to 4 rising numbers from 1 to 16", made.decision, positions)
    with pytest.raises(BufgymError, match="online-optimum: made for L = 3, but the buffer has L = 2"):
        run(made.policy(), [Interruption().episode(5)], 2, V)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"capacity": 0}, "capacity = 0: L must be a whole number >= 1"),
        ({"probabilities": []}, r"probabilities of shape \(0,\)"),
        ({"probabilities": "uniform"}, "probabilities = 'uniform': must be numbers"),
        ({"probabilities": [0.5, -0.25, 0.75]}, r"P\(T = 1\) = -0.25: must be a number >= 0"),
        ({"probabilities": [0.5, 0.25]}, "probabilities add up to 0.75: must add up to 1"),
        ({"v": 0.618}, "v = 0.618: must be a bufgym.model.qoi Value"),
        ({"objective": "regret"}, "objective = 'regret': must be one of ratio, qoi"),
        # C(31, 3) = 4495 for L = 2, T up to 30.
        ({"max_states": 4494}, "L = 2, T up to 30: 4495 states: max_states = 4494"),
        ({"probabilities": np.eye(5001)[5000], "capacity": 2000}, r"about 10\^\d{4} states: max_states = 50000000"),
    ],
)
def test_errors(given, message):
    arguments: dict[str, Any] = {"capacity": 2, "probabilities": uniform(2, 30), "v": V, **given}
    refuse(message, online_optimum, **arguments)


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
    h = np.ones(4)
    by_length(np.array([9, 2, 9, 3, 9]), v.array, np.zeros(5, np.int64), h)
    assert h.tolist() == [1 + v(1), 1 + 2 * v(1), 1 + v(2) + v(1), 1 + 2 * v(2)]


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

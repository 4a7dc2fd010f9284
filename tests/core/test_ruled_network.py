"""Networks among candidates and what gap-price does decide as their weights say, against a reference model."""

import math
from dataclasses import replace

import numpy as np
import pytest
from candidate_cases import found, observed, outputs
from cases import VALUES, Case, cases, same, trace
from hypothesis import assume, given
from hypothesis import strategies as st
from weight_cases import random_ruled

from bufgym import policies
from bufgym.model import observe, qoi
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.model.link import Link
from bufgym.model.past import CHANGED_US
from bufgym.policies import chains, price_dp, rule_inputs, target_gap, thinning, weights
from bufgym.policies.past_inputs import NOTHING
from bufgym.policies.registry import Policy
from bufgym.policies.ruled_network import NOT_OFFERED, fields_seen, seen, watched, watcher
from bufgym.scenario import Episode, messages

kernels = pytest.mark.kernels
RULE = policies.get("gap-price")


def decisions_of(buffer, arrival, slots):
    """What each action among candidates does; None where it is not offered."""
    s = len(buffer.slots)
    room = s < buffer.capacity and buffer.backlog_bytes + int(arrival.size_bytes) <= buffer.max_bytes
    cheapest = REJECT if slots[0] == s or (slots[0] is None and not room) else slots[0]
    does = [ACCEPT if room else cheapest]
    does += [None if j is None or (a == 0 and not room) else REJECT if j == s else j for a, j in enumerate(slots)]
    return does, room


def reference(made, margins):
    """A policy that decides by these weights; by how much the best decision leads goes to ``margins``."""

    def on_arrival(buffer, arrival, memory):
        rule_inputs.recall(buffer, arrival, memory, rule_inputs.BASE)
        known = np.zeros(rule_inputs.N_INPUTS)
        rule_inputs.inputs(buffer, arrival, memory, rule_inputs.BASE, known)
        rule = memory[rule_inputs.RULE :]
        a = price_dp.share(rule, rule_inputs.BASE)
        priced = (price_dp.decide, (a,)) if a > 0 else (target_gap.decide, ())
        by_rule = priced[0](buffer, arrival, rule, rule_inputs.BASE, *priced[1])
        candidates, x = found(buffer, arrival, made.candidates)
        does, room = decisions_of(buffer, arrival, [j for j, _ in candidates])
        numbers = {f.name: f.function(buffer, arrival) for f in observe.ON_BOARD_FIELDS}
        past = [4 * (numbers[name] - nothing) for name, nothing in NOTHING.items()]
        is_even = buffer.past[CHANGED_US] == 0 or (numbers["since_change"] > 0.6 and thinning.steady(buffer))  # 3 s
        is_left = buffer.v[0] != qoi.EXPONENTIAL or a > 0 or target_gap.bursty(rule)
        if is_even or is_left:
            does = [None for _ in does]
        same_as_rule = [float(decision == by_rule) for decision in does]
        state = [float(room), math.log(buffer.capacity / 8)]
        ranked = outputs(made, [*observed(buffer, arrival, candidates, x), *known, *state, *past, *same_as_rule])
        offered = [
            (value, decision) for value, decision in zip(ranked, [*does, by_rule], strict=True) if decision is not None
        ]
        best, decision = max(offered, key=lambda pair: pair[0])
        margins.append(best - max((value for value, other in offered if other != decision), default=-math.inf))
        return decision

    return Policy("reference", on_arrival, memory=rule_inputs.REMEMBERED, work=chains.SCRATCH)


@st.composite
def networks(draw):
    """Any number of candidates, of hidden layers and of units."""
    widths = draw(st.sampled_from([(), (1,), (5,), (4, 3), (3, 2, 4)]))
    activation, k, seed = draw(st.sampled_from(["tanh", "relu"])), draw(st.integers(1, 5)), draw(st.integers(0, 2**32))
    return random_ruled(k, *widths, activation=activation, seed=seed, accept=2.0)


@kernels
@given(case=cases(), v=VALUES, made=networks())
def test_it_decides_as_the_reference_model(case, v, made):
    """Logarithms of the environment are right to 1e-6, so outputs closer than 1e-3 may change places."""
    margins: list[float] = []
    slow = case.run(reference(made, margins), v)
    assume(min(margins, default=1.0) > 1e-3)
    assert same(case.run(made.policy("fast"), v), slow)


def inclined(made, action):
    """The same, with one action above all others."""
    *hidden, (weight, bias) = made.layers
    wanted = np.full_like(bias, -1.0)
    wanted[action] = 1.0
    return replace(made, layers=(*hidden, (np.zeros_like(weight), wanted)))


@kernels
@given(case=cases(), v=VALUES, k=st.integers(1, 4))
def test_with_all_weight_on_its_last_action_it_is_the_rule(case, v, k):
    assert same(case.run(inclined(random_ruled(k, 3), k + 2).policy("ruled"), v), case.run(RULE, v))


@kernels
@given(case=cases(), v=VALUES, k=st.integers(1, 4))
def test_the_watcher_is_the_rule_and_leaves_in_its_memory_what_the_network_sees(case, v, k):
    """Its last decision is the rule's, and each flag says whether an action's decision is the same."""
    met = []

    def on_arrival(buffer, arrival, memory):
        decision = watcher(k).on_arrival(buffer, arrival, memory)
        does, numbers = watched(memory, k)
        same_as_rule = numbers[-(k + 2) :].tolist()
        assert does[-1] == decision
        assert same_as_rule == [float(d == decision and d != NOT_OFFERED) for d in does[:-1].tolist()]
        met.append(numbers.copy())
        return decision

    watching = replace(watcher(k), on_arrival=on_arrival, compile=False)
    assert same(case.run(watching, v), case.run(RULE, v))
    assert all(np.isfinite(numbers).all() for numbers in met)


def test_every_number_that_is_seen_has_a_name():
    for k in (1, 3, 5):
        assert len(fields_seen(k)) == seen(k)


def test_a_file_holds_it(tmp_path):
    made = random_ruled(3, 6, 5, seed=1)
    again = weights.read(weights.save(tmp_path / "mine.safetensors", made, {"name": "mine"}))[0]
    assert type(again) is type(made) and again.candidates == 3
    assert all((a == b).all() for a, b in zip(_numbers(again), _numbers(made), strict=True))


def _numbers(made):
    return [part for layer in made.layers for part in layer]


def streamed(link):
    """The case of a camera with ten messages a second for six seconds, with three places in its queue."""
    return Case(Episode(messages(np.arange(60) * 100_000, 3_000), Link(link, 0, 0)), [], [], 3, None, "arrival")


@kernels
def test_on_a_link_that_has_been_even_for_three_seconds_the_rule_alone_is_offered():
    """A camera sends 30 kB/s. One link carries 10 kB/s all the time, the other 5 and 15 in turn."""
    wavering = [(1_000_000 * s, 10_000 * s - (5_000 if s % 2 else 0)) for s in range(13)]
    links = {"even": [(0, 0), (60_000_000, 600_000)], "wavering": wavering}
    made, alone = inclined(random_ruled(2, 3), 0), {}
    v = qoi.exponential(0.5)
    for name, knots in links.items():
        offered = []

        def on_arrival(buffer, arrival, memory, offered=offered):
            watcher(2).on_arrival(buffer, arrival, memory)
            actions, _ = watched(memory, 2)
            offered.append((int(arrival.arrival_us), bool((actions[:-1] == NOT_OFFERED).all())))
            return int(actions[-1])

        case = streamed(trace(knots, "hold"))
        case.run(replace(watcher(2), on_arrival=on_arrival, compile=False), v)
        alone[name] = [us for us, only in offered if only]
        assert same(case.run(made.policy("fast"), v), case.run(reference(made, []), v))
    assert alone["wavering"] == [0]  # no rate is known when the first message comes
    first, *later = alone["even"]
    assert first == 0 and later and min(later) > 3_000_000
    assert later == list(range(min(later), 6_000_000, 100_000))

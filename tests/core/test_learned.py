"""Learned policies decide as their weights, a slow reference model, a fixed policy and their network say."""

from dataclasses import replace

import numpy as np
import pytest
from cases import VALUES, cases, same
from gap_cases import fits
from hypothesis import given
from hypothesis import strategies as st
from weight_cases import network, score

from bufgym.model import observe
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.policies.learned import NAMES, Network, Weights
from bufgym.policies.registry import Policy

kernels = pytest.mark.kernels
SLOT_NAMES = [field.name for field in (*observe.SLOT_FIELDS, *observe.ON_BOARD_SLOT_FIELDS)]
CONTEXT_NAMES = [field.name for field in (*observe.CONTEXT_FIELDS, *observe.ON_BOARD_FIELDS)]


@st.composite
def weights(draw):
    """Any fields in any order; no, one or two hidden layers."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    on_board = draw(st.sets(st.sampled_from([field.name for field in observe.ON_BOARD_SLOT_FIELDS]), min_size=1))
    others = draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=6, unique=True))
    fields = tuple(dict.fromkeys([*others, *(sorted(on_board) if draw(st.booleans()) else [])]))
    widths = draw(st.sampled_from([(), (1,), (3,), (4, 2), (2, 5)]))
    return Weights(fields, network(rng, len(fields), *widths), network(rng, len(fields), *widths))


def reference(made):
    """A policy that decides by these weights: every candidate is scored, the best is searched for afterwards."""

    def on_arrival(buffer, arrival, memory):
        s, L = len(buffer.slots), buffer.capacity
        slots, context = np.zeros((len(SLOT_NAMES), L + 1)), np.zeros(len(CONTEXT_NAMES))
        observe.observe(buffer, arrival, slots[: len(observe.SLOT_FIELDS)], context[: len(observe.CONTEXT_FIELDS)])
        observe.observe_on_board_slots(buffer, arrival, slots[len(observe.SLOT_FIELDS) :])
        observe.observe_on_board(buffer, arrival, context[len(observe.CONTEXT_FIELDS) :])

        def features(k):
            seen = dict(zip(SLOT_NAMES, slots[:, k], strict=True)) | dict(zip(CONTEXT_NAMES, context, strict=True))
            return [float(seen[name]) for name in made.fields]

        def drop_score(k):
            return score(made.drop, features(k))

        choices, own = [(drop_score(k), k) for k in range(s)], drop_score(L)
        freed = sum(int(buffer.slots[k]["size_bytes"]) for value, k in choices if value >= own)
        excess = buffer.backlog_bytes + int(arrival["size_bytes"]) - buffer.max_bytes
        if buffer.evictions == 0 and freed < excess:
            choices = []  # the newcomer would not fit if all went that score no less
        if buffer.evictions == 0:
            choices.append((own, REJECT))
        best = max(value for value, _ in choices)
        first = next(decision for value, decision in choices if value == best)
        if fits(buffer, arrival) and score(made.accept, features(L)) >= best:
            return ACCEPT
        return first

    return Policy("reference model", on_arrival)


@kernels
@given(cases(), VALUES, weights(), st.integers(1, 20))
def test_decides_as_its_reference_compiled_and_not(case, v, made, capacity):
    case = replace(case, capacity=capacity)
    policy = made.policy("random-weights")
    ours, again, memory = case.run(policy, v), case.senders(v), policy.new_memory(1, capacity)
    memory[:] = np.nan  # what the scratch held before does not matter, nor what the episode left
    for _ in range(2):
        again.load(0, case.episode)
        again.run(policy, memory)
        assert same(ours, again)
    assert same(ours, case.run(reference(made), v))
    assert same(ours, case.run(replace(policy, compile=False), v))
    if case.episode.first_decision == 0 and case.episode.last_decision > len(case.reference_messages):
        assert int(ours.batch.senders["invalid"][0]) == 0


@kernels
def test_the_reference_counts_as_one_does_by_hand():
    # h = relu(2 * 3 - 1, -4 * 3 + 1) = (5, 0); score = 10 * 5 + 100 * 0 + 7 * 3 + 0.5
    weight, bias = np.float32([[2, -4]]), np.float32([-1, 1])
    net = Network(np.float32([7]), np.float32([0.5]), ((weight, bias),), np.float32([10, 100]))
    assert score(net, [3.0]) == 71.5
    # A second layer: relu(5 * 1 + 0 * 9 + 2) = 7; score = -3 * 7 + 7 * 3 + 0.5
    second = (np.float32([[1], [9]]), np.float32([2]))
    assert score(replace(net, layers=(*net.layers, second), out=np.float32([-3])), [3.0]) == 0.5

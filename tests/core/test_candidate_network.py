"""Networks among ordered candidates decide as their weights say: against a reference model in plain Python."""

import math

import numpy as np
import pytest
from candidate_cases import found, observed, outputs
from cases import VALUES, cases, newcomer, queue_of, same
from hypothesis import assume, given
from hypothesis import strategies as st
from weight_cases import random_choices

from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.policies.candidate_network import CandidateWeights, forward, inputs
from bufgym.policies.registry import Policy

kernels = pytest.mark.kernels


def reference(made, margins):
    """A policy that decides by these weights; by how much the best action leads goes to ``margins``."""

    def on_arrival(buffer, arrival, memory):
        s = len(buffer.slots)
        room = s < buffer.capacity and buffer.backlog_bytes + int(arrival.size_bytes) <= buffer.max_bytes
        if room and not made.at_arrivals:
            return ACCEPT
        candidates, x = found(buffer, arrival, made.candidates)
        slots = [j for j, _ in candidates]
        # What each action does. One whose candidate is not there does what the cheapest does; without any, none goes.
        cheapest = slots[0] if slots[0] is not None else ACCEPT if room else REJECT
        does = [cheapest if j is None else j for j in slots]
        shown = [j is not None for j in slots]
        if made.at_arrivals:
            does, shown = [ACCEPT if room else cheapest, *does], [True, shown[0] and room, *shown[1:]]
        ranked = outputs(made, observed(buffer, arrival, candidates, x))
        ranked = sorted(((value, a) for a, value in enumerate(ranked) if shown[a] or not made.masks), reverse=True)
        others = [value for value, a in ranked if does[a] != does[ranked[0][1]]]
        margins.append(ranked[0][0] - max(others, default=-math.inf))
        decision = does[ranked[0][1]]
        return REJECT if decision == s else decision

    return Policy("reference", on_arrival)


@st.composite
def networks(draw):
    """Any number of candidates, of hidden layers and of units."""
    widths = draw(st.sampled_from([(), (1,), (5,), (4, 3), (3, 2, 4)]))
    masks, activation = draw(st.booleans()), draw(st.sampled_from(["tanh", "relu"]))
    k, at_arrivals, seed = draw(st.integers(1, 5)), draw(st.booleans()), draw(st.integers(0, 2**32))
    return random_choices(
        k, at_arrivals, *widths, masks=masks, activation=activation, seed=seed, accept=3.0 * at_arrivals
    )


@kernels
@given(case=cases(), v=VALUES, made=networks())
def test_it_decides_as_the_reference_model(case, v, made):
    """Logarithms of the environment are right to 1e-6, so outputs closer than 1e-3 may change places."""
    margins: list[float] = []
    slow = case.run(reference(made, margins), v)
    assume(min(margins, default=1.0) > 1e-3)
    assert same(case.run(made.policy("fast"), v), slow)


def numpys(made, seen):
    """Outputs by numpy, whose products and sums are rounded to single precision one after another."""
    h = seen
    for layer, (weight, bias) in enumerate(made.layers):
        sums = bias
        for unit, row in zip(h, weight, strict=True):
            sums = sums + unit * row if unit else sums
        if layer < len(made.layers) - 1:
            sums = np.maximum(sums, np.float32(0)) if made.activation == "relu" else [math.tanh(x) for x in sums]
        h = np.float32(sums)
    return h


@kernels
@given(made=networks(), seed=st.integers(0, 2**32))
def test_outputs_are_numpys_bit_for_bit(made, seed):
    rng, size = np.random.default_rng(seed), inputs(made.candidates)
    seen = rng.normal(size=size).astype(np.float32) * (rng.random(size) < 0.7)
    units = np.zeros(size + sum(len(bias) for _, bias in made.layers) + made.widest, np.float32)
    units[:size] = seen
    expected = numpys(made, seen)
    first = forward(made.parameters(), units, size)
    assert units[first : first + len(expected)].tobytes() == expected.tobytes()


def test_a_network_without_hidden_layers_by_hand():
    """Three messages of one byte at x = 0, 1, 4 after one at -2, and a newcomer at 5, whose last step was 1.

    Gaps left: 3 for the slot at 0, 4 at 1, 4 at 4, 2 for the newcomer. So the order is newcomer, slot 0; the head is
    slot 0 too. The outputs are the numbers of ``candidate_place``: 1 for the newcomer, 2 / 4 - 1 = -0.5 for slot 0.
    """
    weight = np.zeros((inputs(2), 3), np.float32)
    weight[:3, :3] = np.eye(3)
    made = CandidateWeights(2, False, False, "relu", ((weight, np.zeros(3, np.float32)),))
    buffer, arrival = queue_of(3, 3, made.parameters()), newcomer()
    for slot, x in zip(buffer.slots, (0.0, 1.0, 4.0), strict=True):
        slot["x"], slot["size_bytes"] = x, 1
    arrival.x = 5.0
    buffer = buffer._replace(dequeued_x=-2.0, previous_x=4.0, backlog_bytes=3)
    policy = made.policy("by-hand")
    memory = policy.new_memory(1, 3)[0]
    assert policy.on_arrival(buffer, arrival, memory) == REJECT
    assert memory[:3].tolist() == [3, 0, 0]  # the order of the candidates
    assert memory[3:6].tolist() == [2, 3, 3]  # the gaps left
    weight[:3] *= -1  # now the least place wins; of equal outputs the first action
    buffer = buffer._replace(parameters=made.parameters())
    assert policy.on_arrival(buffer, arrival, memory) == 0
    # With room for a fourth message it is not asked.
    assert policy.on_arrival(buffer._replace(capacity=4), arrival, memory) == ACCEPT


def test_masks_decide_about_actions_whose_candidate_is_missing():
    """An empty queue of L = 1 behind a busy link: the newcomer is the only candidate, and there is no head.

    Output 3, the head, is the highest. With masks the next one is taken, which is 0 and accepts. Without masks the head
    that is missing does what the cheapest does: the newcomer goes. Where the link is idle nothing may go.
    """
    bias = np.float32([2, 1, 0, 3])
    for masks, busy, decision in ((True, 1, ACCEPT), (False, 1, REJECT), (False, 0, ACCEPT)):
        layer = np.zeros((inputs(2), 4), np.float32), bias
        made = CandidateWeights(2, True, masks, "relu", (layer,))
        policy = made.policy("masked")
        buffer = queue_of(0, 1, made.parameters())._replace(busy=busy)
        assert policy.on_arrival(buffer, newcomer(), policy.new_memory(1, 1)[0]) == decision

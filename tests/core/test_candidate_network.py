"""Networks among ordered candidates decide as their weights say: against a reference model in plain Python."""

import functools
import math

import numpy as np
import pytest
from cases import VALUES, cases, newcomer, queue_of, same
from hypothesis import assume, given
from hypothesis import strategies as st
from weight_cases import random_choices

from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.policies.candidate_network import CandidateWeights, inputs
from bufgym.policies.registry import Policy

kernels = pytest.mark.kernels
NO_CANDIDATE = None


def lg(a, b):
    """log(a / b), at most 3 either way; 0 if both are 0."""
    if a <= 0 or b <= 0:
        return 0.0 if a <= 0 and b <= 0 else 3.0 if a > 0 else -3.0
    return min(max(math.log(a / b), -3.0), 3.0)


def found(buffer, arrival, k):
    """[(slot, cost)] of the k cheapest and the head; s for the newcomer, None for a candidate that is not there."""
    s, step = len(buffer.slots), float(arrival.x - buffer.previous_x)
    x = [buffer.dequeued_x, *(float(m["x"]) for m in buffer.slots), float(arrival.x), float(arrival.x) + step]
    sizes = [*(int(m["size_bytes"]) for m in buffer.slots), int(arrival.size_bytes)]
    mean = sum(sizes) / (s + 1)
    cost = {j: (x[j + 2] - x[j]) * (mean / sizes[j]) for j in range(s + 1)}
    there = [j for j in cost if j < s or buffer.evictions == 0]

    def compare(a, b):
        """Within 1e-12 the older comes first."""
        return a - b if abs(cost[a] - cost[b]) <= 1e-12 else math.copysign(1, cost[a] - cost[b])

    there.sort(key=functools.cmp_to_key(compare))
    best = [*(there + k * [NO_CANDIDATE])[:k], 0 if s > 0 else NO_CANDIDATE]
    return [(j, 0.0 if j is None else cost[j]) for j in best], x


def observed(buffer, arrival, candidates, x):
    """The numbers of the text of ``bufgym.model.observe.candidates``, one after another."""
    s, L, size = len(buffer.slots), buffer.capacity, int(arrival.size_bytes)
    even = (x[s + 1] - x[0]) / (L + 1)
    columns = []
    for j, cost in candidates:
        if j is None:
            columns.append([0.0] * 6)
            continue
        gaps = [lg(cost, 2 * even), lg(x[j + 1] - x[j], even), lg(x[j + 2] - x[j + 1], even)]
        columns.append([2 * (j + 1) / (s + 1) - 1, float(j == s), float(j == 0), *gaps])
    short, medium, rate = (
        1e-6 * r for r in (buffer.short_rate_bytes_per_s, buffer.medium_rate_bytes_per_s, buffer.long_rate_bytes_per_s)
    )
    period, one = max(buffer.period_us, 1.0), qoi_value(buffer.v, even)
    bend = min(2 * (2 * one - qoi_value(buffer.v, 2 * even)) / one - 1, 1.0) if one > 0 else -1.0
    queue = [
        lg(buffer.left_bytes, short * period),
        lg(short, rate),
        lg(medium, rate),
        lg(rate * period * math.e**2, size),
        lg((arrival.x - buffer.previous_x) * math.e, even),
        lg(rate * (arrival.arrival_us - buffer.dequeued_arrival_us), (L + 1) * size),
        lg(rate * buffer.stalled_us, size),
        bend,
        2 * s / L - 1,
    ]
    return [*np.array(columns).T.reshape(-1), *queue]


def qoi_value(v, distance):
    return float(qoi.value(v, distance))


def outputs(made, numbers):
    """The layers of the module's text, unit by unit."""
    g = math.tanh if made.activation == "tanh" else lambda total: max(total, 0.0)
    h = [float(number) for number in numbers]
    for layer, (weight, bias) in enumerate(made.layers):
        sums = [math.fsum(f * float(w) for f, w in zip(h, weight[:, o], strict=True)) for o in range(len(bias))]
        h = [total + float(b) for total, b in zip(sums, bias, strict=True)]
        if layer < len(made.layers) - 1:
            h = [g(total) for total in h]
    return h


def reference(made, margins):
    """A policy that decides by these weights; by how much the best action leads goes to ``margins``."""

    def on_arrival(buffer, arrival, memory):
        s = len(buffer.slots)
        room = s < buffer.capacity and buffer.backlog_bytes + int(arrival.size_bytes) <= buffer.max_bytes
        if room and not made.at_arrivals:
            return ACCEPT
        candidates, x = found(buffer, arrival, made.candidates)
        slots = [j for j, _ in candidates]
        # What each action does. One whose candidate is not there does what the cheapest does.
        does = [slots[0] if j is None else j for j in slots]
        shown = [j is not None for j in slots]
        if made.at_arrivals:
            does, shown = [ACCEPT if room else slots[0], *does], [True, shown[0] and room, *shown[1:]]
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

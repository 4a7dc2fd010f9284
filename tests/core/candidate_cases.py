"""Reference model of what networks among candidates see, in plain Python: slots in order, numbers one after another."""

import functools
import math

import numpy as np

from bufgym.model import qoi

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
    may_reject = buffer.evictions == 0 and (s > 0 or buffer.busy > 0)
    there = [j for j in cost if j < s or may_reject]

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

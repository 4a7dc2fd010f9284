"""Plans for small queues: what the file says is done, and is the optimum; where there is none, none is followed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from cases import newcomer, queue_of

from bufgym import files, policies
from bufgym.model import qoi
from bufgym.model.buffer import REJECT
from bufgym.oracle import law, online_optimum
from bufgym.oracle.lengths import EveryLength
from bufgym.policies import small_queue
from bufgym.policies.small_queue import BASES, CAPACITIES, LONGEST, NONE
from bufgym.scenario import Interruption

TEXT = Path(small_queue.__file__).with_suffix(".txt").read_text(encoding="utf-8")
LINES = [line.split() for line in TEXT.splitlines()]
AGENT = policies.load(files.shipped("agents", "agents/pretrained", "*.safetensors")["learned-motion"])


def asked(kept, t, *, base=0.618, v=None, step=1.0, capacity=None, shift=0.0):
    """The plan's answer to the ``t``-th arrival of an interruption, of messages a step apart; ``kept`` are queued."""
    buffer = queue_of(len(kept), capacity or len(kept))._replace(v=(v or qoi.exponential(base)).array)
    buffer.slots["x"] = np.array(kept) * step + shift
    arrival = newcomer()
    arrival["x"] = t * step
    return small_queue.planned(buffer._replace(previous_x=(t - 1) * step), arrival, small_queue.packed())


def test_the_file_has_a_plan_for_each_base_and_length():
    assert [(float(b), int(L)) for b, L, _ in LINES] == [(round(b, 6), L) for b in BASES for L in CAPACITIES]
    for _, L, digits in LINES:
        assert len(digits) == LONGEST - int(L) and set(digits) <= set("01234"[: int(L) + 1])
    assert any(math.isclose(b, 0.618) for b in BASES) and any(math.isclose(b, 0.9) for b in BASES)


@pytest.mark.kernels
@pytest.mark.parametrize("number", range(0, len(LINES), 5))
def test_each_digit_is_what_is_evicted(number):
    base, L, digits = float(LINES[number][0]), int(LINES[number][1]), LINES[number][2]
    kept = list(range(1, L + 1))
    for t, digit in enumerate(digits, L + 1):
        expected = int(digit) if int(digit) < L else REJECT
        if t < 60 or t % 37 == 0:
            assert asked(kept, t, base=base) == expected
        kept.append(t)
        del kept[int(digit)]


@pytest.mark.nightly
@pytest.mark.parametrize(("L", "t_max"), [(1, 400), (2, 300), (3, 120), (4, 70)])
@pytest.mark.parametrize("v", [qoi.exponential(0.618), qoi.exponential(0.9), qoi.saturating(8)], ids=str)
def test_an_agent_with_shortcuts_loses_no_more_than_the_optimum(v, L, t_max):
    lengths = EveryLength(Interruption(t_max=t_max, value=v), [L])
    optimum = online_optimum(L, law(lengths.scenario), v, objective="qoi").policy()
    assert lengths.regrets(AGENT)[0] == pytest.approx(lengths.regrets(optimum)[0], abs=1e-12)


@pytest.mark.kernels
def test_a_plan_counts_steps_of_whatever_size():
    # 0.9^4.567 = 0.618: a scene that moves 4.567 at each arrival is that of the other base.
    step = math.log(0.618) / math.log(0.9)
    for t in range(5, 12):
        assert asked([1, 2, 3, 4], t, base=0.9, step=step) == asked([1, 2, 3, 4], t, base=0.618)
    assert asked([1, 2, 3, 4], 5, base=0.9, step=step) != NONE


@pytest.mark.kernels
def test_where_there_is_no_plan():
    assert asked([1, 2, 3, 4], 5) != NONE
    assert asked([1, 2, 3, 4, 5], 6) == NONE  # L = 5
    assert asked([1, 2, 3], 4, capacity=4) == NONE  # there is room
    assert asked([1, 2, 3, 4], 5, v=qoi.saturating(8)) == NONE
    assert asked([1, 2, 3, 4], 5, base=0.999) == NONE and asked([1, 2, 3, 4], 5, base=0.1) == NONE
    assert asked([1, 2, 3, 4], 5, shift=0.01) == NONE  # other messages than the plan has kept
    assert asked([1], LONGEST + 1) == NONE
    assert asked([1, 2, 3, 4], 5, step=0.0) == NONE

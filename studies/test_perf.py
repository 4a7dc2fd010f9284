"""The speed report at tiny sizes, its history, and the microbenchmark beside the environment."""

import json
import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from refusal_cases import refuse

import bufgym.envs  # noqa: F401  (registers)
from bufgym.jit import named
from bufgym.sim.rollout import python_arrival, python_view
from studies import microbenchmark, perf

TINY = perf.Sizes(3, (2, 1), 24, 20, 1, 1)


def test_every_figure_is_a_number_with_its_ratio_and_definition(tmp_path: Path) -> None:
    figures = perf.measure(TINY)
    text = perf.report(figures, TINY.repeats)
    for figure in figures:
        assert math.isfinite(figure.value) and figure.value > 0 and figure.definition, figure.name
        assert figure.ratio and math.isfinite(figure.ratio), figure.name
        assert figure.name in text and figure.definition in text, figure.name
    assert figures[0].name == "microbenchmark" and len({figure.name for figure in figures}) == len(figures)
    perf.write_json(figures, TINY, tmp_path / "perf.json")
    read = json.loads((tmp_path / "perf.json").read_text())
    assert [figure["name"] for figure in read["figures"]] == [figure.name for figure in figures]


def test_a_history_says_what_fell_below_the_median_of_the_last_five(tmp_path: Path) -> None:
    file = tmp_path / "new" / "perf.jsonl"

    def message(ratio: float, sizes: perf.Sizes = TINY) -> str:
        return perf.remember([perf.Measurement("batch", 1.0, "steps/s", ratio, "")], sizes, file)

    for ratio in (1.0, 1.0, 1.0, 9.0, 0.9, 1.1):
        assert message(ratio).startswith("no ratio"), ratio
    assert message(0.86).startswith("no ratio fell") and message(0.84) == (
        "fell by more than 15% below the median of the last 5 runs: batch: 0.84 after 1"
    )
    assert message(0.1, perf.Sizes()).startswith("no ratio"), "other sizes"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert len(lines) == 9 and lines[3]["ratios"] == {"batch": 9.0}
    file.write_text("nothing\n")
    refuse("not a history", message, 1.0)


def test_the_yardstick_writes_the_numbers_of_the_environment() -> None:
    """It is set to the state of an environment; those that need its link and past stay out."""
    env: Any = gym.make("bufgym/Uplink-v1", capacity=4, observation="flat", actions="slots").unwrapped
    flat, info = env.reset(seed=3)
    for k in range(40):
        flat, _, ended, _, info = env.step(5 if info["action_mask"][5] else k % 4)
        assert not ended
    buffer, arrival = (
        python_view(named(env.sub_envs.senders.batch), 0),
        python_arrival(named(env.sub_envs.senders.batch), 0),
    )
    bare, s = microbenchmark.Bare.new(1, 4), len(buffer.slots)
    at_s, x, size, gain = bare.places[0]
    zero = buffer.dequeued_arrival_us
    rows = [*buffer.slots, arrival]
    at_s[1 : s + 2] = [(row.arrival_us - zero) * 1e-6 for row in rows]
    x[0], x[1 : s + 2] = buffer.dequeued_x, [row.x for row in rows]
    size[1 : s + 2] = [row.size_bytes for row in rows]
    bare.previous[0, :2] = (buffer.previous_us - zero) * 1e-6, buffer.previous_x
    at_s[s + 2] = 2 * at_s[s + 1] - bare.previous[0, 0]
    x[s + 2] = 2 * x[s + 1] - bare.previous[0, 1]
    gain[1:] = 1 - np.exp(-microbenchmark.STEEP * np.diff(x))
    bare.state[0, microbenchmark.QUEUED] = s
    mine, mask = np.zeros((1, 56), np.float32), np.zeros((1, 6), np.int8)
    microbenchmark.observe(bare, 0, mine, mask)
    assert s >= 2 and mask[0].tolist() == info["action_mask"].tolist()
    of_v = {*range(30, 35), *range(40, 45)}  # losses: this V is another
    places = [k for k in range(49) if k not in of_v]
    assert mine[0, places] == pytest.approx(flat[places], abs=2e-4)

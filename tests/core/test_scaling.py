"""Units of x are no matter: with x and V in other units, every policy decides the same."""

from functools import cache
from itertools import product

import numpy as np
import pytest

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.traces import synthetic_lte

FPS, FRAME_BYTES, FRAMES, SEEDS = 30, 20_000, 150, 5
VALUES = {
    "exponential": lambda unit: qoi.exponential(0.618 ** (1 / unit)),
    "saturating": lambda unit: qoi.saturating(4 * unit),
    "tabulated": lambda unit: qoi.tabulated([0, 2 * unit, 10 * unit, 60 * unit], [0, 0.5, 0.8, 1]),
}
BLIND = [name for name in policies.names(for_topics=False) if policies.get(name).privileged is None]


@cache
def episode(seed, unequal, unit):
    """Steps of a camera that now rests and now turns, no two alike, over a link that carries a third of the frames."""
    rng = np.random.default_rng(seed)
    x, spread = np.cumsum(rng.gamma(0.5, 2, FRAMES)), np.exp(rng.normal(0, 0.4, FRAMES))
    sizes = np.rint(FRAME_BYTES * (spread if unequal else 1)).astype(int) * np.ones(FRAMES, int)
    arrivals = messages(np.arange(FRAMES) * 1_000_000 // FPS, sizes, x * unit)
    arrivals["uniform"] = rng.random(FRAMES)
    return Episode(arrivals, Link(synthetic_lte(seed, mean_bytes_per_s=0.3 * FPS * FRAME_BYTES)))


def dropped(name, kind, unequal, L, unit):
    """When each message is dropped, int64[episodes, messages]."""
    policy = policies.get(name)
    if name == "keyframe":  # its step is in units of x
        policy = policy.with_parameters(step=policy.parameters["step"] * unit)
    batch = run(policy, [episode(s, unequal, unit) for s in range(SEEDS)], L, VALUES[kind](unit)).batch
    return np.asarray(batch.log)["dropped_us"]


@pytest.mark.parametrize("name", BLIND)
def test_a_change_of_units_changes_no_decision_in_240_episodes(name):
    changed = dict.fromkeys(VALUES, 0)
    for kind, unequal, L in product(VALUES, (False, True), (1, 3, 8, 24)):
        plain = dropped(name, kind, unequal, L, 1)
        for unit in (1 / 3, 1000 / 7):
            changed[kind] += int((dropped(name, kind, unequal, L, unit) != plain).any(axis=1).sum())
    assert changed == dict.fromkeys(VALUES, 0)

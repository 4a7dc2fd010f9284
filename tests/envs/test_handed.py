"""Observations that are handed out again once nobody holds them, and never before."""

import weakref
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from bufgym.envs.observation import Handed, ObservationForm
from bufgym.model.observe import CONTEXT_FIELDS, SLOT_FIELDS

FORM = ObservationForm("dict", SLOT_FIELDS, CONTEXT_FIELDS, 3)
NUMBERS = FORM.numbers


def row(number: float) -> Any:
    return np.full(NUMBERS, number, np.float32)


def address(observation: dict[str, Any]) -> int:
    return int(observation["loss"].ctypes.data)


def test_what_nobody_holds_is_filled_again() -> None:
    handed = Handed(FORM)
    first = address(handed.of(row(1)))
    again = handed.of(row(2))
    assert address(again) == first and again["busy"][0] == 2


def test_what_someone_holds_stays_as_it_is() -> None:
    """The dict, one of its arrays, a part of one, or what shares an array's memory."""
    handed = Handed(FORM)
    dict_held = handed.of(row(1))
    array_held = handed.of(row(2))["rank"]
    part_held = handed.of(row(3))["loss"][1:]
    shared = memoryview(handed.of(row(4))["size"])
    for number in range(5, 12):
        assert handed.of(row(number))["busy"][0] == number
    assert all((array == 1).all() for array in dict_held.values())
    assert (array_held == 2).all() and (part_held == 3).all() and list(shared) == [4] * 4


def test_a_collector_gets_an_observation_of_its_own_each_time() -> None:
    handed = Handed(FORM)
    collected = [handed.of(row(number)) for number in range(20)]
    assert [observation["busy"][0] for observation in collected] == list(range(20))
    arrays = [weakref.ref(observation["busy"]) for observation in collected]
    collected[0].clear()  # a dict that its owner changes changes no other
    assert list(handed.of(row(2))) == list(FORM.space)
    del collected
    assert sum(array() is not None for array in arrays) < 5  # few are kept for use again


@pytest.mark.parametrize("id", ["bufgym/Uplink-v0", "bufgym/Topics-v0"])
def test_compact_is_the_context_fields_of_all_fields(id: str) -> None:
    whole, compact = (gym.make_vec(id, 3, capacity=5, **options) for options in ({}, {"fields": "compact"}))
    (seen, _), (part, _) = whole.reset(seed=1), compact.reset(seed=1)
    for action in range(60):
        context = [name for name, numbers in seen.items() if numbers.shape[1] == 1]
        assert list(part) == context
        assert all((part[name] == seen[name]).all() for name in context)
        (seen, *_), (part, *_) = whole.step(np.full(3, action % 7)), compact.step(np.full(3, action % 7))


def test_what_an_owner_does_to_a_batch_s_dicts_changes_no_other() -> None:
    batch = gym.make_vec("bufgym/Uplink-v0", 2, capacity=3)
    batch.reset(seed=1)
    for _ in range(9):
        seen, *_, info = batch.step(np.zeros(2, np.int64))
        assert {"rank", "busy"} <= set(seen) and {"qoi", "_qoi"} <= set(info) and "retained" in info["reward_terms"]
        seen.clear()
        info["reward_terms"].clear()
        info.clear()

"""Environments that name built-in fields: rows hold these alone, with the numbers that they have in the whole table."""

from typing import Any

import numpy as np
import pytest
from env_cases import SMALL

from bufgym.envs import SenderEnv, SenderVectorEnv
from bufgym.model.link import Link
from bufgym.model.observe import BUILT_IN, CANDIDATE_FIELDS, QUEUE_FIELDS, field
from bufgym.scenario import Episode, messages
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

L, N = 4, 3
SETTING: dict[str, Any] = {"capacity": L, **SMALL["bufgym/Uplink-v1"]}
RNG = np.random.default_rng(7)
SUBSETS = [[name] for name in BUILT_IN]
SUBSETS += [RNG.choice(list(BUILT_IN), size, replace=False).tolist() for size in (2, 4, 4, 8, 16, len(BUILT_IN))]
ACTIONS = RNG.integers(0, 3, (25, N))


def seen_by(fields: Any, actions: str, form: str = "dict", single: bool = False) -> list[Any]:
    """Every observation of ``ACTIONS``, of a batch or of a single environment with its first row's seed."""
    options: dict[str, Any] = {**SETTING, "fields": fields, "actions": actions, "observation": form}
    if single:
        env = SenderEnv("lte", **options)
        found = [env.reset(seed=5)[0]]
        for action in ACTIONS[:, 0]:
            seen, _, ended, *_ = env.step(action)
            assert env.observation_space.contains(seen)
            found.append(seen)
            if ended:
                break
        return found
    batch = SenderVectorEnv(N, "lte", autoreset_mode="Disabled", **options)
    found = [batch.reset(seed=5)[0]]
    for action in ACTIONS:
        seen, _, ended, *_ = batch.step(action)
        assert batch.observation_space.contains(seen)
        found.append(seen)
        if ended.any():
            break
    return found


@pytest.mark.kernels
@pytest.mark.parametrize("actions", ["slots", "candidates"])
def test_named_fields_are_those_of_the_whole_table(actions: str) -> None:
    """Each alone and random subsets, in a batch and in the single environment, compiled and not."""
    every = seen_by(list(BUILT_IN), actions)
    assert {name for name in every[0] if name in BUILT_IN} == set(BUILT_IN) and len(every) > 20
    if actions == "slots":
        for seen, whole in zip(every, seen_by(None, actions), strict=True):
            for name in whole:
                np.testing.assert_array_equal(seen[name], whole[name], name)
    for names in SUBSETS:
        for found, whole in zip(seen_by(names, actions), every, strict=True):
            for name in names:
                np.testing.assert_array_equal(found[name], whole[name], name)
    for names in SUBSETS[-6:]:
        for one, whole in zip(seen_by(names, actions, single=True), every, strict=False):
            for name in names:
                np.testing.assert_array_equal(one[name], whole[name][0], name)


def test_a_flat_row_holds_what_is_named_and_nothing_else() -> None:
    """The tables' fields keep their order, slots before the context, and others follow in the order of their names."""
    names = ["load", "busy", "gap_per_byte", "loss", "index_before", "occupancy", "rank"]
    order = ["rank", "loss", "gap_per_byte", "index_before", "occupancy", "busy", "load"]
    for flat, whole in zip(seen_by(names, "slots", "flat"), seen_by(list(BUILT_IN), "slots"), strict=True):
        assert flat.shape == (N, 4 * (L + 1) + 3)
        np.testing.assert_array_equal(flat, np.concatenate([whole[name] for name in order], axis=1))


def test_named_fields_follow_the_candidates() -> None:
    names = ["busy", "rank", "rate_long"]  # a slot field comes first, then the context, as named
    table = len(CANDIDATE_FIELDS) * 3 + len(QUEUE_FIELDS)
    alone, beside = seen_by(None, "candidates", "flat"), seen_by(names, "candidates", "flat")
    every = seen_by(list(BUILT_IN), "candidates")
    for plain, seen, whole in zip(alone, beside, every, strict=True):
        assert (plain.shape[1], seen.shape[1]) == (table, table + L + 1 + 2)
        np.testing.assert_array_equal(seen[:, :table], plain)
        named = np.concatenate([whole[name] for name in ("rank", "busy", "rate_long")], axis=1)
        np.testing.assert_array_equal(seen[:, table:], named)


@pytest.mark.kernels
def test_fields_beside_candidates_by_hand() -> None:
    """L = 2, a message a second, a dead link: 0 is in transmission, 1 and 2 queue, and 3 is the first to ask."""
    arrivals = messages(np.arange(5) * 1_000_000, 1_000)
    env = SenderEnv("lte", 2, fields=["rank", "occupancy", "time_merged"], observation="dict")
    link = Link(Trace.steps([(100.0, 0.0), (100.0, 1e6)]), 0, 0)
    seen, _ = env.reset(options={"episode": Episode(arrivals, link)})
    assert env.sub_envs.senders.batch.senders["next"][0] == 3
    np.testing.assert_array_equal(seen["rank"], np.float32([1 / 3, 2 / 3, 1]))
    assert seen["occupancy"].tolist() == [1.0]
    # Three gaps of a second up to the newcomer: the even spacing is 1 s, and each message leaves a gap of two of them.
    assert seen["time_merged"].tolist() == [0.5, 0.5, 0.5]
    seen, *_ = env.step(2)  # drop-oldest: 2 and 3 queue, 4 asks, and 0 was the last to be dequeued
    # The even spacing is 4/3 s. Without message 2 a gap of 3 s is left; without 3 or 4, one of 2 s.
    np.testing.assert_allclose(seen["time_merged"], [3 / (3 + 8 / 3), 2 / (2 + 8 / 3), 2 / (2 + 8 / 3)], rtol=1e-6)


def test_a_slot_that_has_emptied_reads_zero() -> None:
    """The numbers of an earlier step are wiped out, as arrays are used again."""
    for seen in seen_by(["occupied", "occupancy", "index_merged"], "slots"):
        queued = np.rint(seen["occupancy"][:, 0] * L).astype(int)
        assert (seen["occupied"][:, :L].sum(axis=1) == queued).all()
        empty = seen["occupied"] == 0
        assert not seen["index_merged"][empty].any()


def test_own_fields_stand_beside_built_in_ones() -> None:
    field("quarter", per="context", compile=True)(lambda buffer, arrival: 0.25)
    for actions in ("slots", "candidates"):
        alone, both = seen_by(["quarter"], actions), seen_by(["quarter", "rank"], actions)
        for one, two in zip(alone, both, strict=True):
            assert set(two) - set(one) == {"rank"}
            np.testing.assert_array_equal(one["quarter"], two["quarter"])
        assert (alone[0]["quarter"] == 0.25).all()


@pytest.mark.parametrize("name", ["rank", "rate_long", "queue_fill", "candidate_head", "priority"])
def test_no_field_of_one_s_own_has_a_built_in_name(name: str) -> None:
    with pytest.raises(BufgymError, match=f"field '{name}': a built-in field has this name"):
        field(name, per="context")


@pytest.mark.parametrize("actions", ["slots", "candidates"])
def test_a_name_that_is_none_is_told_with_the_nearest(actions: str) -> None:
    with pytest.raises(BufgymError, match="unknown field 'rate_lon'; did you mean 'rate_long'"):
        SenderEnv("lte", fields=["rate_lon"], actions=actions)

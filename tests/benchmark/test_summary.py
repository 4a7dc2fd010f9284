"""The summary that topics and fleets share: intervals over episodes, means over cells, what does not fit together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pytest
from summary_cases import exactly

from bufgym.benchmark.episodes import Numbers
from bufgym.benchmark.summary import Quantity, Run, Summary, plain, summarise
from bufgym.benchmark.table import score
from bufgym.errors import BufgymError

QUANTITIES = (
    Quantity("mean", "mean", score, "of H", interval=False),
    Quantity("over", "H / base's", score, "sum over sum", versus="base"),
    Quantity("seen", "episodes", "{:g}".format, "how many", interval=False, total=True),
)


def statistics(ours: Numbers, theirs: Numbers, weights: Numbers) -> dict[str, Numbers]:
    h, base = weights @ ours[:, 0], weights @ theirs[:, 0]
    return {"mean": h / len(ours), "over": h / base, "seen": weights.sum(axis=1)}


def runs(policies: Mapping[str, list[float]], scenario: str = "s", capacity: int = 4) -> dict[Run, list[float]]:
    """H by policy and episode."""
    return {(scenario, capacity, name, "t", k): [h] for name, hs in policies.items() for k, h in enumerate(hs)}


def summary(numbers: Mapping[Run, list[float]], **options: Any) -> Summary:
    return summarise(numbers, statistics, QUANTITIES, rank_by="over", baseline="base", **options)


NOISY = runs({"base": [10, 100, 50, 20], "mine": [11, 108, 57, 23]})
"""Episodes differ tenfold, the two policies in any of them by 8 to 15 %."""


def test_intervals_are_paired_and_repeatable() -> None:
    found = summary(NOISY, seed=1)
    over = found.standings["mine"]["over"]
    assert over.value == pytest.approx(199 / 180)
    # No resample leaves the range of the single ratios.
    assert 1.08 <= over.low < over.value < over.high <= 1.15
    assert summary(dict(reversed(NOISY.items())), seed=1).overall == found.overall


def test_over_all_cells_it_is_the_mean_of_theirs_or_their_sum() -> None:
    other = runs({"base": [1, 1], "mine": [3, 3]}, "other", 9)
    found = summary({**runs({"base": [2, 2, 2], "mine": [1, 1, 1]}), **other})
    assert list(found.cells) == [("s", 4), ("other", 9)]  # as in the runs
    assert [standing.policy for standing in found.cells["s", 4]] == ["base", "mine"]
    mine = found.standings["mine"]
    assert mine["over"] == exactly((0.5 + 3) / 2) and mine["seen"] == exactly(5)


def test_one_episode_has_no_interval() -> None:
    found = summary(runs({"base": [2], "mine": [3]}))
    value, low, high = found.standings["mine"]["over"]
    assert value == 1.5 and math.isnan(low) and math.isnan(high)
    lines = [line.split() for line in plain(found).splitlines()]
    assert lines[3:] == [["mine", "3.000", "1.500", "[–]", "1"], ["base", "2.000", "–", "1"]]


def test_unranked_policies_come_last() -> None:
    numbers = runs({"base": [1, 1], "endless": [9, 9]})
    assert [standing.policy for standing in summary(numbers).overall] == ["endless", "base"]
    found = summary(numbers, unranked=["endless"]).overall
    assert [(standing.policy, standing.ranked) for standing in found] == [("base", True), ("endless", False)]


@pytest.mark.parametrize(
    ("numbers", "options", "message"),
    [
        ({}, {}, "no rows to score"),
        (runs({"mine": [1]}), {}, "s, L = 4: no row of the baseline 'base'"),
        (runs({"base": [1, 2], "mine": [1]}), {}, "mine at s, L = 4, trace t, seed 1: no row; every policy must meet"),
        ({**NOISY, **runs({"base": [1]}, capacity=9)}, {}, "base at s, L = 9, trace t, seed 1: no row"),
        (NOISY, {"resamples": 0}, "resamples = 0"),
        (NOISY, {"confidence": 95}, "confidence = 95"),
    ],
)
def test_runs_that_cannot_be_summed_up(numbers: dict[Run, list[float]], options: dict[str, Any], message: str) -> None:
    with pytest.raises(BufgymError, match=message):
        summary(numbers, **options)

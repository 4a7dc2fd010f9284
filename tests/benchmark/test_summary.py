"""The summary that topics and fleets share, by hand; by how much a policy beats another live and in the simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pytest
from sweep_cases import exactly

from bufgym.benchmark.episodes import Numbers
from bufgym.benchmark.live_runs import margins
from bufgym.benchmark.summary import Quantity, Run, Summary, plain, summarise
from bufgym.benchmark.table import score
from bufgym.errors import BufgymError
from bufgym.live.runs import Run as LiveRun

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


def one(policy: str, seed: int, live: float, simulated: float, transport: str = "tcp") -> LiveRun:
    return LiveRun(policy, "a", seed, 1, 1, live, simulated, 5.0, transport)


AFR = [one("afr", 0, 4.0, 4.0), one("afr", 1, 3.0, 3.0)]


def test_margins_by_hand() -> None:
    """Of 10 in all, 0.1 + 0.2 are won live and 0.2 + 0.2 in the simulator; an episode is drawn twice, or each once."""
    [margin] = margins([*AFR, one("random", 0, 4.1, 4.2), one("random", 1, 3.2, 3.2)])
    assert (margin.policy, margin.reference, margin.episodes) == ("random", "afr", 2)
    assert margin.live == pytest.approx((0.03, 0.02, 0.04))
    assert margin.simulated == pytest.approx((0.04, 0.04, 0.04))
    assert margin.share == pytest.approx((0.75, 0.5, 1.0))
    assert str(margin) == (
        "random against afr, 2 episodes: regret lower by 3.00 % [2.00, 4.00] live, 4.00 % [4.00, 4.00] simulated: "
        "75.0 % [50.0, 100.0] of the simulator's margin is there live."
    )


def test_an_episode_over_two_transports_is_one() -> None:
    again = [one(policy, seed, 4.5, 4.5, "ros1") for policy in ("afr", "random") for seed in (0, 1)]
    [margin] = margins([*AFR, one("random", 0, 4.1, 4.2), one("random", 1, 3.2, 3.2), *again])
    assert margin.episodes == 2 and margin.live.value == pytest.approx(0.3 / 20)


def test_nothing_is_said_of_a_single_episode_or_without_the_reference() -> None:
    assert margins([AFR[0], one("random", 0, 4.1, 4.2)]) == []
    assert margins([one("random", 0, 4.1, 4.2), one("random", 1, 4.1, 4.2)]) == []


def test_there_is_no_share_of_nothing() -> None:
    [margin] = margins([*AFR, one("random", 0, 4.1, 4.0), one("random", 1, 3.2, 3.0)])
    assert str(margin).endswith("[2.00, 4.00] live, 0.000 % [0.000, 0.000] simulated.")

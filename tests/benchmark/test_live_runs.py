"""By how much one policy beats another live, and in the simulator."""

from __future__ import annotations

import pytest

from bufgym.benchmark.live_runs import margins
from bufgym.live.runs import Run


def one(policy: str, seed: int, live: float, simulated: float, transport: str = "tcp") -> Run:
    return Run(policy, "a", seed, 1, 1, live, simulated, 5.0, transport)


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

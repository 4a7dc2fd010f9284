"""Margins of a policy over another, live beside simulated, by hand."""

import pytest

from bufgym_live.robot.margins import margins
from bufgym_live.robot.runs import LiveRun


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


def test_nothing_is_said_of_a_single_episode_or_without_the_reference() -> None:
    assert margins([AFR[0], one("random", 0, 4.1, 4.2)]) == []
    assert margins([one("random", 0, 4.1, 4.2), one("random", 1, 4.1, 4.2)]) == []

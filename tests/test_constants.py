"""Constant actions and chance: policies that play as the environment does when nothing is learned."""

from collections.abc import Sequence
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import bufgym  # noqa: F401  (registers the environments)
from agents.constants import CONSTANT, NAMES, UNTAUGHT
from agents.evaluation import play
from agents.mixed_env import Cell
from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.scenario import Episode
from bufgym.scenario.numbered import draw

LTE = scenarios.get("lte", duration_s=20.0)
EPISODES = [draw(LTE, seed) for seed in range(6)]
L = 5


def qoi(policy: policies.Policy, episodes: Sequence[Episode] = EPISODES) -> list[float]:
    """H of each episode."""
    return [outcome.qoi for outcome in play(policy, [Cell("", LTE, L)], [len(episodes)], episodes)]


@pytest.mark.parametrize("action", range(len(CONSTANT)))
def test_a_constant_action_does_what_it_does_in_the_environment(action: int) -> None:
    n = len(EPISODES)
    envs = gym.make_vec("bufgym/Uplink-v1", n, capacity=L, scenario=LTE)
    envs.reset(seed=0, options={"episodes": EPISODES})
    found, over = np.zeros(n), np.zeros(n, np.bool_)
    while not over.all():
        *_, terminated, _, info = envs.step(np.full(n, action))
        ended = terminated & ~over
        found[ended] = info["qoi"][ended] if ended.any() else 0.0
        over |= ended
    assert qoi(CONSTANT[action]) == pytest.approx(found, abs=1e-9)


def test_the_cheapest_always_is_a_rule_and_chance_is_far_below() -> None:
    cheapest, second, chance = map(qoi, UNTAUGHT)
    assert cheapest == qoi(policies.get("min-motion-gap")) and cheapest != second
    assert max(chance[k] - min(cheapest[k], second[k]) for k in range(6)) < 0  # in every episode
    assert NAMES == ("always 0", "always 1", "chance")


def test_chance_takes_each_action_a_third_of_the_time() -> None:
    """Draws of 1/6, 1/2 and 5/6 are the three actions in their order, whatever the queue."""
    made = EPISODES[0]
    by_draw = []
    for u in (1 / 6, 1 / 2, 5 / 6):
        arrivals = made.arrivals.copy()
        arrivals["uniform"] = u
        by_draw.append(qoi(UNTAUGHT[-1], [replace(made, arrivals=arrivals)])[0])
    assert by_draw == [qoi(policy)[0] for policy in (*CONSTANT, policies.get("drop-oldest"))]

"""A policy as the player of an environment, and what is compiled beforehand."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import pytest
from refusal_cases import refuse

import bufgym.envs  # noqa: F401  (registers)
from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.benchmark.run import run
from bufgym.envs.expert import Player
from bufgym.policies import Policy
from bufgym.scenario import Interruption, Uplink
from bufgym.scenario.numbered import draw
from bufgym.sim import run as run_senders
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

PLAYABLE = [p.name for p in map(policies.get, policies.names()) if not (p.drops_at_dequeue or p.unbounded)]

GAPPY = Uplink(traces=(Trace.steps([(1.0, 900_000), (0.7, 0)], name="t"),), rate_hz=20, duration_s=5)


def played(env: Any, player: Player, episode: Any) -> dict[str, Any]:
    env.reset(options={"episode": episode})
    ended, info = False, {}
    while not ended:
        _, _, ended, _, info = env.step(player.action(env.sub_envs.senders))
    refuse("no decision is due", player.action, env.sub_envs.senders)
    return info


@pytest.mark.parametrize("name", PLAYABLE)
@pytest.mark.parametrize("scenario", [Interruption(t_max=40), GAPPY], ids=["interruption", "uplink"])
def test_a_player_in_the_environment_does_what_the_benchmark_does(name: str, scenario: Any) -> None:
    env: Any = gym.make("bufgym/Uplink-v1", scenario=scenario, capacity=3, actions="slots").unwrapped
    for row in run([policies.get(name)], scenario, [3], 2):
        info = played(env, Player(policies.get(name)), draw(scenario, row["seed"]))
        assert (info["delivered"], info["qoi"]) == (row["delivered"], pytest.approx(row["qoi"]))


@pytest.mark.parametrize("name", ["robofleet", "edf", "drop-oldest"])
def test_a_player_of_topics_reaches_what_its_policy_reaches(name: str) -> None:
    """At arrivals and at a free socket: the same deliveries and the same weighted QoI as a rollout's."""
    client = replace(scenarios.get("topics"), duration_s=2.0)
    episode, policy = draw(client, 3), policies.get(name)
    reached = outcome(run_senders(policy, [episode], 6, client.value, topics=client.topics), 0)
    info = played(gym.make("bufgym/Topics-v0", scenario=client, capacity=6).unwrapped, Player(policy), episode)
    assert info["qoi"] == pytest.approx(reached.qoi)
    assert (info["delivered"], info["invalid"]) == (reached.delivered, reached.invalid)


def test_a_player_refuses_a_decision_that_means_nothing() -> None:
    env: Any = gym.make("bufgym/Interruption-v1", capacity=3, actions="slots").unwrapped
    env.reset(seed=0)
    for decision, says in ((3, "decision 3"), (None, "on_arrival returned None: must be a whole number")):
        with pytest.raises(BufgymError, match=f"policy odd: {says}"):
            Player(Policy("odd", lambda buffer, arrival, memory: decision)).action(env.sub_envs.senders)  # noqa: B023
    env = gym.make("bufgym/Topics-v0", capacity=3).unwrapped
    env.reset(seed=0)
    env.step(4)  # accept: now the socket asks
    with pytest.raises(BufgymError, match="policy odd: sends slot 3"):
        odd = Policy("odd", policies.get("fifo").on_arrival, on_send=lambda buffer, memory: 3)
        Player(odd).action(env.sub_envs.senders)
    for name, why in (("codel", "drops at dequeue"), ("rosbridge", "has an unbounded queue")):
        refuse(f"policy {name} {why}", Player, policies.get(name))

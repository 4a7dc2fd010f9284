"""The agents that come with bufgym: small, named, with their command, and as good as their file says."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bufgym import files, policies
from bufgym.benchmark.run import by_trace, draw
from bufgym.benchmark.tasks.bound import best
from bufgym.model import qoi
from bufgym.oracle import integer, law
from bufgym.policies import learned, weights
from bufgym.scenario import Interruption, suites
from bufgym.sim import run

SHIPPED = files.shipped("agents", "agents/pretrained", "*.safetensors")
NAMED = files.shipped("agents/named", "agents/pretrained/named", "*.safetensors")


def test_there_are_two_one_without_odometry() -> None:
    assert set(SHIPPED) == {"learned-time", "learned-motion"}
    assert not {"motion", "value"} & set(groups("learned-time"))
    assert {"motion", "value"} <= set(groups("learned-motion"))


def groups(name: str) -> list[str]:
    """What it takes to know what the agent reads."""
    known = {field.name: field.group for field in (*weights.FIELDS, *weights.ON_BOARD_SLOT_FIELDS)}
    return [known[field] for field in weights.read(SHIPPED[name])[0].fields]


@pytest.mark.parametrize("name", SHIPPED)
def test_its_file_is_small_and_tells_how_it_was_made(name: str) -> None:
    _, told = weights.read(SHIPPED[name])
    assert SHIPPED[name].stat().st_size < 8_000
    assert told["name"] == name and told["about"]
    assert told["training"].startswith("python train.py --suite ") and told["seeds"]
    for score in told["scores"].values():
        low, high = score["interval"]
        assert low <= score["score"] <= high
    assert policies.get(name).summary == told["about"]


@pytest.mark.parametrize("name", SHIPPED)
def test_its_regret_in_interruptions_is_what_its_file_says(name: str) -> None:
    """Exactly, over every length of the test split, by other code than that which noted it: a run for each length."""
    told = weights.read(SHIPPED[name])[1]["regret"]
    policy, setting = policies.get(name), suites.get("interruption-v1").settings("test")["exponential-0.618"]
    scenario = setting.scenario
    assert isinstance(scenario, Interruption)
    lengths = [T for T in range(scenario.t_max + 1) if law(scenario)[T] > 0]
    for L in (4, 16):
        senders = run(policy, [scenario.episode(T) for T in lengths], L, scenario.value)
        reached = senders.batch.senders["delivered_gain"] + 1
        share = law(scenario)[lengths]
        most = share @ [1 + integer(L, T, scenario.value) for T in lengths]
        assert 1 - share @ reached / most == pytest.approx(told[f"exponential-0.618, L = {L}"], abs=1e-8)


def test_motion_is_worth_something_on_fading_links() -> None:
    """Four test links of lte-v1 with camera motion, L = 15: with odometry < on time alone < AFR's regret."""
    scenario = suites.get("lte-v1").settings("test")["motion"].scenario
    episodes = [draw(link, seed=1) for _, link in by_trace(scenario)[:4]]
    most = sum(best(episode, 15, scenario).qoi for episode in episodes)

    def regret(name: str) -> float:
        senders = run(policies.get(name), episodes, 15, scenario.value)
        return float(1 - (senders.batch.senders["delivered_gain"] + 1).sum() / most)

    assert regret("learned-motion") < regret("afr")
    assert regret("learned-motion") < regret("learned-time")


@pytest.mark.parametrize("name", SHIPPED)
def test_over_a_link_that_flows_it_is_worth_more_than_its_scorers_alone(name: str) -> None:
    """On a link of a quarter of the demand, and over the fading links of generated-v1's validation."""
    whole = weights.read(SHIPPED[name])[0]
    assert whole.shortcuts and whole.thins
    alone = learned.policy("alone", replace(whole, thins=False))
    for suite, label in (("sustained-v1", "time-quarter"), ("generated-v1", "time-900kB")):
        scenario = suites.get(suite).settings("validation")[label].scenario
        episodes = [draw(one, seed=1) for _, one in by_trace(scenario)]
        rivals = (policies.get("afr"), alone, policies.get(name))
        reached = [run(one, episodes, 10, scenario.value).batch.senders["delivered_gain"].sum() for one in rivals]
        assert reached[0] < reached[1] < reached[2]


def test_where_v_is_straight_and_then_flat_both_lose_nothing_in_an_interruption() -> None:
    scenario = Interruption(t_max=400, value=qoi.saturating(8))
    for name in SHIPPED:
        assert weights.read(SHIPPED[name])[1]["regret"]["saturating-8, L = 16"] == 0
        senders = run(policies.get(name), [scenario.episode(200)], 16, scenario.value)
        assert senders.batch.senders["delivered_gain"][0] == pytest.approx(integer(16, 200, scenario.value), rel=1e-12)


def test_learned_ppo_is_named_and_tells_how_it_was_made() -> None:
    _, told = weights.read(NAMED["learned-ppo"])
    assert told["training"].startswith("python train.py --suite lte-v1,sustained-v1 --steps 1000000")
    assert "learned-ppo" in policies.names(named_only=True) and policies.get("learned-ppo").named_only


def test_the_same_weights_serve_a_buffer_nobody_trained_them_for() -> None:
    """L = 100 and a V of the user's own."""
    scenario = Interruption(t_max=600, value=qoi.tabulated([0, 3, 10], [0, 0.7, 1]))
    for name in SHIPPED:
        senders = run(policies.get(name), [scenario.episode(600)], 100, scenario.value)
        assert int(senders.batch.senders["transmitted"][0]) == 102
        assert int(senders.batch.senders["invalid"][0]) == 0

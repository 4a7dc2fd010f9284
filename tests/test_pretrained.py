"""The agents that come with bufgym: small, named, with their command, and as good as their file says."""

import pytest

from bufgym import policies
from bufgym.benchmark.run import by_trace, draw
from bufgym.benchmark.run import run as rows_of
from bufgym.ground import files
from bufgym.model import qoi
from bufgym.oracle import EveryLength
from bufgym.policies import weights
from bufgym.scenario import Interruption, suites
from bufgym.sim import run

SHIPPED = files.shipped("agents", "agents/pretrained", "*.safetensors")
NAMED = files.shipped("agents/named", "agents/pretrained/named", "*.safetensors")
TOPICS = files.shipped("agents/topics", "agents/pretrained/topics", "*.safetensors")


@pytest.mark.parametrize("name", {**SHIPPED, **TOPICS, **NAMED})
def test_its_file_is_small_and_tells_how_it_was_made(name: str) -> None:
    file = {**SHIPPED, **TOPICS, **NAMED}[name]
    _, told = weights.read_any(file)
    policy = policies.get(name)
    assert file.stat().st_size < (8_000 if name not in NAMED else 200_000)
    assert told["name"] == name and told["training"].startswith(("python train.py --suite ", "python -m agents.joint "))
    assert told["seeds"] and policy.summary == told["about"] != ""
    assert (policy.for_topics, policy.named_only) == (name in TOPICS, name in NAMED)
    assert name in policies.names(for_topics=name in TOPICS, named_only=name in NAMED)


def test_until_the_link_has_carried_anything_learned_is_the_rule() -> None:
    """In an interruption, over every length of the test split."""
    for setting in suites.get("interruption-v1").settings("test").values():
        lengths = EveryLength(setting.scenario, (4, 16))
        assert lengths.regrets(policies.get("learned")) == lengths.regrets(policies.get("gap-price"))


@pytest.mark.parametrize("name", SHIPPED)
def test_over_a_link_that_flows_it_is_worth_more_than_afr(name: str) -> None:
    """On a link of a quarter of the demand, and over the fading links of generated-v1's validation."""
    for suite, label in (("sustained-v1", "time-quarter"), ("generated-v1", "time-900kB")):
        scenario = suites.get(suite).settings("validation")[label].scenario
        episodes = [draw(one, seed=1) for _, one in by_trace(scenario)]
        rivals = (policies.get("afr"), policies.get(name))
        afr, ours = (run(one, episodes, 10, scenario.value).batch.senders["delivered_gain"].sum() for one in rivals)
        assert afr < ours


@pytest.mark.parametrize("name", SHIPPED)
def test_its_weights_serve_other_v_and_l(name: str) -> None:
    """L = 100 with a V of the user's own."""
    scenario = Interruption(t_max=600, value=qoi.tabulated([0, 3, 10], [0, 0.7, 1]))
    senders = run(policies.get(name), [scenario.episode(600)], 100, scenario.value).batch.senders
    assert (senders["transmitted"][0], senders["invalid"][0]) == (102, 0)


@pytest.mark.nightly
def test_on_the_first_test_episode_of_each_setting_the_scheduler_is_above_robofleet() -> None:
    """Weighted QoI is larger; the first topics no older; no message lost that may not be."""
    names, settings = ("learned-scheduler", "robofleet"), suites.get("topics-v1").settings("test")
    rivals = [policies.get(name) for name in names]
    ages = dict.fromkeys(names, 0.0)
    for label, setting in settings.items():
        rows = rows_of(rivals, by_trace(setting.scenario)[0][1], (32,), [0], label=label)
        ours, theirs = ([row for row in rows if row["policy"] == name] for name in names)
        assert ours[0]["weighted_qoi"] > theirs[0]["weighted_qoi"]
        assert sum(row["lost"] for row in ours if row["no_drop"]) == 0
        for row in rows:
            ages[row["policy"]] += row["mean_age_s"] * (row["priority"] == 20)
    assert ages["learned-scheduler"] < ages["robofleet"]

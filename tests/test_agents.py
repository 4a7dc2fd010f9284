"""The parts of training on a suite: mixed rows, evaluation sets, records, shipped agents."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from agents import mixed_env, runs
from agents.evaluation import EvaluationSet, sweep_for
from agents.settings import Hindsight, Tune
from agents.tasks import Suites
from bufgym import policies
from bufgym.benchmark.run import run as rows_of
from bufgym.envs import SenderVectorEnv
from bufgym.model import qoi
from bufgym.model.qoi import exponential
from bufgym.oracle.interruption import EveryLength
from bufgym.policies import weights
from bufgym.sb3 import GymVecEnv
from bufgym.scenario import Interruption, suites
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim import run
from bufgym.utils import files

SHORT = Interruption(law="uniform", t_min=6, t_max=30)
STEEP = dataclasses.replace(SHORT, value=exponential(0.2))
MIXED = [mixed_env.Cell("short", SHORT, 3), mixed_env.Cell("steep", STEEP, 5)]
SUITE = Hindsight(suites=Suites(("interruption-v1",), capacities=(4, 8)), validation_episodes=60)


def mixed_rows() -> mixed_env.MixedEnv:
    return mixed_env.MixedEnv(MIXED, [3, 4], reward="retained", info="mask")


def test_a_row_of_a_mix_is_the_environment_of_its_cell() -> None:
    """Rows 0 to 2 are of the first cell, 3 to 6 of the second: the same seeds alone give the same numbers."""
    env, rng = mixed_rows(), np.random.default_rng(0)
    alone = [
        SenderVectorEnv(n, c.scenario, c.capacity, autoreset_mode="SameStep", reward="retained", info="mask")
        for c, n in zip(MIXED, (3, 4), strict=True)
    ]
    env.reset(seed=5)
    for group, other, first in zip(env.groups, alone, (5, 8), strict=True):
        other.reset(seed=[first + i for i in range(group.num_envs)])
        group.reset(seed=[first + i for i in range(group.num_envs)])
    for _ in range(40):
        actions = rng.integers(3, size=7)
        seen, rewards, ended, truncated, info = env.step(actions)
        parts = [other.step(actions[rows]) for other, rows in zip(alone, (slice(0, 3), slice(3, 7)), strict=True)]
        for mixed, own in zip((seen, rewards, ended, truncated), zip(*parts, strict=True), strict=False):
            assert np.array_equal(mixed, np.concatenate(own))
        assert bool(info) == bool(ended.any())
        if ended.any():
            assert [final is not None for final in info["final_obs"]] == ended.tolist()


def test_a_suite_is_met_within_its_settings_limits() -> None:
    """Under B = 1.84 MB, twenty messages of mean size, jpeg-v1 has one L, 31; its others are met with L = 8 and 15."""
    met = mixed_env.cells("jpeg-v1", "train", (8, 15))
    limited = [cell for cell in met if cell.label.endswith("-bytes")]
    assert {(cell.capacity, cell.max_bytes) for cell in limited} == {(31, 1_840_000)}
    assert {cell.capacity for cell in met if cell.max_bytes is None} == {8, 15}
    (rows,) = mixed_env.MixedEnv(limited[:1], [2], info="mask").groups
    assert rows.sub_envs.senders.max_bytes == 1_840_000 and rows.sub_envs.capacity == 31


def test_rewards_add_up_to_the_information_and_rows_begin_anew() -> None:
    env = GymVecEnv(mixed_rows())
    env.seed(0)
    env.reset()
    ends = 0
    for _ in range(120):
        total = env._returns.copy()
        _, rewards, done, infos = env.step(np.zeros(7, np.int64))
        for i in np.flatnonzero(done):
            assert infos[i]["episode"]["r"] == pytest.approx(total[i] + rewards[i])
            assert not infos[i]["terminal_observation"].any()
            if ends > 14:  # a row's first episode is joined somewhere in its middle
                assert infos[i]["episode"]["r"] > 0
            ends += 1
    assert ends > 14


def test_an_agent_that_acts_like_a_policy_has_its_rows_and_its_score(tmp_path: Path) -> None:
    few = dataclasses.replace(SUITE, validation_episodes=12)
    plan, file = sweep_for(few, "interruption-v1", "validation"), tmp_path / "set" / "manifest.json"
    evaluation = EvaluationSet(plan, tmp_path / "set")
    assert len(evaluation.fixed("afr")) == 12
    assert evaluation.verdict(evaluation.play(policies.get("drop-oldest"))).score == 0
    rows = evaluation.benchmark_rows(evaluation.play(policies.get("drop-oldest")), "agent", training_seed=7)
    fixed = {(r["scenario"], r["seed"], r["capacity"]): r for r in evaluation.rows if r["policy"] == "drop-oldest"}
    assert len(rows) == len(fixed) == 12
    for row in rows:
        other = fixed[row["scenario"], row["seed"], row["capacity"]] | {"policy": "agent", "training_seed": 7}
        assert row == pytest.approx(other, nan_ok=True)
    # A second reading makes nothing anew.
    written = file.stat().st_mtime_ns
    assert (EvaluationSet(plan, tmp_path / "set").fixed("afr") == evaluation.fixed("afr")).all()
    assert file.stat().st_mtime_ns == written


def test_a_record_goes_on_where_the_checkpoint_was(tmp_path: Path) -> None:
    columns = ("steps", "seconds", "qoi")
    record = runs.Record(tmp_path / "curve.csv", columns, 0)
    for steps in (10, 20, 30):
        record.append(steps, steps / 10, 0.5)
    assert runs.Record(tmp_path / "curve.csv", columns, 20).rows == [(10, 1, 0.5), (20, 2, 0.5)]
    assert (tmp_path / "curve.csv").read_text().split() == ["steps,seconds,qoi", "10,1.0,0.5", "20,2.0,0.5"]


def test_the_best_validation_is_the_earliest_of_equals(tmp_path: Path) -> None:
    validations = runs.Validations(tmp_path, ("regret",), min, Tune(steps=40, validate_every=20), 0)
    assert validations.due(0)
    best = [validations.add(steps, 0.0, (regret,)) for steps, regret in ((0, 0.5), (20, 0.4), (30, 0.4))]
    assert best == [True, True, False] and validations.best[0] == 20
    assert [validations.due(steps) for steps in (30, 40, 49, 50)] == [False, True, True, True]


# The agents that come with bufgym: small, named, with their command, and as good as their file says.

SHIPPED = files.shipped("agents", "agents/pretrained", "*.safetensors")
NAMED = files.shipped("agents/named", "agents/pretrained/named", "*.safetensors")


@pytest.mark.parametrize("name", {**SHIPPED, **NAMED})
def test_its_file_is_small_and_tells_how_it_was_made(name: str) -> None:
    file = {**SHIPPED, **NAMED}[name]
    _, meta = weights.read(file)
    policy = policies.get(name)
    assert file.stat().st_size < (60_000 if name not in NAMED else 200_000)
    assert meta["name"] == name and meta["training"].startswith("python train.py ")
    assert meta["seeds"] and policy.summary == meta["about"] != ""
    assert (policy.for_topics, policy.named_only) == (False, name in NAMED)
    assert name in policies.names(for_topics=False, named_only=name in NAMED)


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
    names, settings = ("gap-priority", "robofleet"), suites.get("topics-v1").settings("test")
    rivals = [policies.get(name) for name in names]
    ages = dict.fromkeys(names, 0.0)
    for label, setting in settings.items():
        rows = rows_of(rivals, by_trace(setting.scenario)[0][1], (32,), [0], label=label)
        ours, theirs = ([row for row in rows if row["policy"] == name] for name in names)
        assert ours[0]["weighted_qoi"] > theirs[0]["weighted_qoi"]
        assert sum(row["lost"] for row in ours if row["no_drop"]) == 0
        for row in rows:
            ages[row["policy"]] += row["mean_age_s"] * (row["priority"] == 20)
    assert ages["gap-priority"] < ages["robofleet"]

"""Agents that a whole fleet shares: where they are tried, and that a run goes on."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import train_cases  # noqa: F401  (it skips without the extra)
from cli_cases import Capsys, shown

import train
from agents.learner import learner_of
from agents.objectives import fleet
from agents.settings import PPO
from agents.tasks import Suites
from bufgym import policies
from bufgym.benchmark import folder as folder_of
from bufgym.benchmark.rows import read_rows
from bufgym.benchmark.run import run
from bufgym.benchmark.tasks import TASKS, FleetTask
from bufgym.policies import weights
from bufgym.policies.candidate_network import CandidateWeights
from bufgym.scenario import suites
from bufgym.scenario.numbered import by_trace, draw
from bufgym.scenario.suites import Setting

FLEET_V1 = suites.get("fleet-v1")


def two_robots(split: str, data: Path | None) -> dict[str, Setting]:
    ((label, setting),) = FLEET_V1.build(split, data).items()
    return {label: dataclasses.replace(setting, scenario=dataclasses.replace(setting.scenario, robots=2))}


SUITE = dataclasses.replace(FLEET_V1, build=two_robots, capacities=(3, 4))
"""fleet-v1 with two robots, and buffers so small that most arrivals ask for something to be dropped."""

TASK = TASKS["fleet"]

ON = Suites(("fleet-v1",), test_seeds=1)
SMALL: dict[str, Any] = {"num_envs": 4, "batch_size": 64, "width": 8, "steps": 256, "validate_every": 128}
SMALL |= {"reward": "retained", "gamma": 0.9}
BY_PPO = PPO(suites=ON, name="tiny", n_steps=32, epochs=1, **SMALL)


@pytest.fixture(autouse=True)
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(suites.SUITES, "fleet-v1", SUITE)
    monkeypatch.setattr(fleet, "VALIDATION_EPISODES", 1)
    monkeypatch.setattr(FleetTask, "default_policies", lambda self: ["afr", "drop-oldest"])


def test_team_qoi_is_what_the_benchmark_says_of_the_same_episodes() -> None:
    robots = by_trace(fleet.fleet_of(ON, "validation"))[0][1]
    robots = dataclasses.replace(robots, uplink=dataclasses.replace(robots.uplink, duration_s=2.0))
    cell = fleet.FleetEpisodes(robots, [draw(robots, seed) for seed in (0, 1)], 4)
    mean = TASK.summary(run([policies.get(name) for name in ("afr", "min-gap")], robots, [4], 2)).standings
    assert cell.rival == pytest.approx(mean["afr"]["team"].value)
    assert cell.team_qoi(policies.get("min-gap")) == pytest.approx(mean["min-gap"]["team"].value)
    gain = -cell.measure(policies.get("min-gap"))
    assert gain == pytest.approx(mean["min-gap"]["gain"].value) and gain != 0
    assert cell.measure(policies.get("afr")) == 0  # again and again the same
    assert cell.decisions == 2 * 2 * 60


def test_ppo_shares_weights_over_robots_and_its_agent_needs_no_torch(capsys: Capsys) -> None:
    learner: Any = learner_of(BY_PPO)
    env: Any = learner.env(Path())
    assert env.num_envs == 4 and env.envs.sub_envs.capacity == 4  # two cells of two robots, at the middle L
    assert env.action_space.n == 3
    train.main(BY_PPO)
    folder = Path("runs/tiny")
    rows = read_rows(folder / "rows.csv", TASK.layout)
    assert {row["capacity"] for row in rows if row["policy"] == "agent (seed 0)"} == {3, 4}
    agent, noted = weights.read(folder / "model.safetensors")
    assert isinstance(agent, CandidateWeights) and agent.candidates == 2 and noted["algo"] == "ppo"
    shown(["export", folder / "model.safetensors", "mine.safetensors", "--name", "mine"], capsys)
    words = "bench --suite fleet-v1 --policies mine.safetensors,afr --capacity 3 --seeds 1 --jobs 1 --out played"
    shown(words.split(), capsys)
    played = [row["qoi"] for row in folder_of.read(Path("played")).rows if row["policy"] == "mine"]
    of_run = [row["qoi"] for row in rows if row["policy"] == "agent (seed 0)" and row["capacity"] == 3]
    assert played == of_run
    table = folder / "seed-0" / "validation.csv"
    before = table.read_text().splitlines()
    train.main(dataclasses.replace(BY_PPO, resume=True, steps=512))
    after = table.read_text().splitlines()
    assert after[: len(before)] == before and after[-1].split(",")[0] == "512"

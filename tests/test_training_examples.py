"""The examples that train or measure run, with tiny settings, and do what they say."""

import importlib.util
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_cases import Capsys, Patch
from needs import needs

import bufgym
from bufgym.benchmark import leaderboard
from bufgym.jit import JIT

pytestmark = pytest.mark.skipif(not JIT, reason=needs("compiled", "they train and measure, which takes compiled code"))

torch = pytest.importorskip("torch", reason=needs("extras", "torch"))

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def example(name: str) -> dict[str, Any]:
    """The names that an example defines; what stands under ``__main__`` is not run."""
    return runpy.run_path(str(EXAMPLES / name))


def test_ppo_trains_and_tests_on_the_benchmarks_episodes(capsys: Capsys) -> None:
    ppo = example("ppo.py")
    tiny = {"num_envs": 4, "num_steps": 8, "steps": 96, "minibatch": 16, "width": 8, "epochs": 1, "duration_s": 4.0}
    result = ppo["main"](ppo["Settings"](**tiny, capacity=2, test_seeds=2))
    assert 0 < result["afr_regret"] < 1 and 0 < result["regret"] <= 1 and result["score"] <= 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("afr: score") and lines[1].startswith("0 decisions:")
    assert lines[-1].startswith("96 decisions:")


def test_ppos_parts_by_hand() -> None:
    """gamma = lambda = 1/2. Last: 1 + 3/2 - 2 = 0.5; first: 1 + 2/2 - 1 + 0.5/4 = 1.125, or 1 - 1 where it ended."""
    ppo = example("ppo.py")
    values = torch.tensor([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    advantages = ppo["advantages_of"](torch.ones(2, 2), values, torch.tensor([[0.0, 1.0], [0.0, 0.0]]), 0.5, 0.5)
    assert advantages.tolist() == [[1.125, 0.0], [0.5, 0.5]]


@pytest.mark.nightly
def test_a_model_of_stable_baselines3_gets_a_row(tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    pytest.importorskip("sb3_contrib", reason=needs("extras", "sb3_contrib"))
    args = "--suite interruption-v1 --capacity 4 --steps 512 --num-envs 4 --out mine -- --seeds 3 --capacity 4 --jobs 1"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["x", *args.split()])
    example("sb3_to_leaderboard.py")["main"]()
    board = leaderboard.read(Path("mine/leaderboard.csv"))
    assert {entry.policy for entry in board.values()} == {"mine/model.zip", "afr", "drop-oldest"}
    row = board["interruption-v1/mine/model.zip"]
    assert row.values["score"].value <= 1 and row.rank in (1, 2, 3)
    assert row.command == "bufgym bench --suite interruption-v1 --policies mine/model.zip"
    assert f"`{row.command.replace(row.policy, 'POLICY')}` makes a row again" in capsys.readouterr().out


def test_a_moment_is_missed_more_than_half_a_view_from_what_arrived() -> None:
    """Frames 0 and 3 arrived, at 0 and 2: those at 0.5 and 1.6 are near one, that at 1 is not, nor that at 2.6."""
    view = example("view_missed.py")
    x, arrived = np.array([0.0, 0.5, 1.0, 1.6, 2.0, 2.6]), np.array([1, 0, 0, 0, 1, 0], bool)
    assert view["missed"](x, arrived, 0.5) == 2 / 6
    assert view["missed"](x, np.zeros(6, bool), 0.5) == 1


@pytest.mark.nightly
def test_imitation_learns_from_the_clairvoyant(capsys: Capsys) -> None:
    """Seconds are enough to pass AFR on short episodes; a network that learned nothing is below Drop Oldest."""
    pytest.importorskip("sb3_contrib", reason=needs("extras", "sb3_contrib"))
    imitation = example("imitation.py")
    small = {"rounds": 3, "episodes": 16, "epochs": 4, "minibatch": 256, "width": 16, "test_seeds": 5}
    reached = imitation["main"](imitation["Settings"](**small, duration_s=6.0, test_duration_s=10.0))
    assert list(reached) == ["imitation", "min-motion-gap", "afr", "drop-oldest"]
    assert reached["imitation"] > reached["afr"] > reached["drop-oldest"] == 0
    shown = capsys.readouterr().out
    assert "round 3: 8,640 states" in shown and "score of imitation: 0." in shown


@pytest.mark.nightly
def test_offline_learns_from_a_data_set(tmp_path: Path, capsys: Capsys) -> None:
    """A clone of AFR is far above a network that learned nothing; CQL runs, and its values keep to the masks."""
    for package in ("d3rlpy", "minari", "sb3_contrib"):
        pytest.importorskip(package, reason=needs("extras", package))
    offline = example("offline.py")
    small = {"episodes": 8, "updates": 60, "minibatch": 256, "test_seeds": 2, "duration_s": 4.0}
    settings = offline["Settings"](kinds=["medium"], data=str(tmp_path), **small, test_duration_s=4.0)
    reached = offline["main"](settings)
    assert reached["cloning-medium"] > -0.5 and "cql-medium" in reached and reached["drop-oldest"] == 0
    assert "cql of 960 medium steps" in capsys.readouterr().out
    from gymnasium.spaces.utils import flatdim

    seen = torch.zeros(1, flatdim(offline["FIELDS"]))
    seen[0, [0, 1, offline["L"]]] = 1.0  # slots 0 and 1, and the newcomer
    valid = offline["scored"](offline["new_network"](settings), seen)[0] > -1e5
    assert valid.tolist() == [True, True, *[False] * 6, True, True]


MISSING = [name for name in ("ray", "tree", "ormsgpack", "torch", "pettingzoo") if not importlib.util.find_spec(name)]


@pytest.mark.nightly
@pytest.mark.skipif(bool(MISSING), reason=needs("trainers", f"{', '.join(MISSING)} missing"))
def test_the_example_learns_two_iterations() -> None:
    small = ["--robots", "2", "--iterations", "2", "--ticks", "400", "--seconds", "3"]
    command = [sys.executable, "examples/fleet_rllib.py", *small]
    done = subprocess.run(command, cwd=EXAMPLES.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    returns = re.findall(r"iteration \d: [1-9]\d* episodes, return ([\d.]+)", done.stdout)
    assert len(returns) == 2, done.stdout
    # The sum over two robots of H - 1, where V <= 1 and 90 frames arrive.
    assert all(0 < float(total) < 2 * 90 for total in returns)


def test_an_agent_of_the_paper_learns_on_its_suite(tmp_path: Path) -> None:
    """One agent of the six, for one episode or two; then it is there, and is not trained again."""
    pytest.importorskip("matplotlib", reason=needs("extras", "matplotlib"))
    assert sum(line != "" for line in (EXAMPLES / "paper.py").read_text().splitlines()) <= 60
    from bufgym.sb3 import as_policy

    paper = example("paper.py")
    for _ in range(2):
        paper["train"](("dqn", 0), 400, tmp_path)
        (curve,) = bufgym.curves(tmp_path / "dqn", tmp_path / "curves.svg")
        assert curve.measure == "return" and 200 < curve.steps[-1] <= 400 and len(curve.seeds) == 1
        paper["TRAINERS"].clear()
    model = as_policy(tmp_path / "dqn" / "seed-0" / "model.zip", "mine")
    done = bufgym.compare([model, paper["every_second"], "afr"], "halls-v1", seeds=1, progress=False)
    assert {e["policy"] for e in done.estimates} == {"mine", "every_second", "afr", "drop-oldest"}
    assert done.write_estimates(tmp_path / "all.csv").read_text().startswith("policy,scenario,capacity,quantity,est")


@pytest.mark.nightly
def test_a_papers_worth_from_one_program(tmp_path: Path) -> None:
    """Two agents with three seeds beside three rules: a table of ten rows, its numbers, and a figure of two runs."""
    pytest.importorskip("stable_baselines3", reason=needs("extras", "stable_baselines3"))
    pytest.importorskip("matplotlib", reason=needs("extras", "matplotlib"))
    words = [sys.executable, str(EXAMPLES / "paper.py"), "--steps", "400", "--episodes", "1", "--out", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "table.tex").read_text()
    names = [f"{name}-{seed}" for name in ("ppo", "dqn") for seed in range(3)]
    assert all(table.count(f"& {name} &") == 1 for name in [*names, r"every\_second", "target-gap", "afr"])
    assert (tmp_path / "estimates.csv").read_text().startswith("policy,scenario,capacity,quantity,estimate,low,high\n")
    assert all(f"{name} (3 seeds)" in (tmp_path / "curves.svg").read_text() for name in ("ppo", "dqn"))

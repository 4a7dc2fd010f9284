"""Training and tuning on a suite of one's own, ``module:NAME``, as ``bench`` takes it."""

import json
from pathlib import Path

import pytest
from cli_cases import Capsys, Patch
from refusal_cases import refuse
from train_cases import in_a_folder_of_its_own  # noqa: F401

import train
from agents.settings import PPO
from agents.tasks import Place, Suites
from agents.tuning_episodes import Task
from bufgym import policies
from bufgym.scenario import suites

LAB = """
import bufgym
from bufgym.scenario import Interruption
LAB = bufgym.suite("lab-v1", {"short": "interruption:law=fixed,t_max=12", "long": Interruption()}, capacity=4, seeds=10)
"""


@pytest.fixture(autouse=True)
def lab(in_a_folder_of_its_own: None, monkeypatch: Patch) -> None:  # noqa: F811
    """Two interruptions, L = 4, ten episodes each."""
    monkeypatch.setattr(suites, "SUITES", dict(suites.SUITES))
    monkeypatch.syspath_prepend(str(Path.cwd()))
    Path("lab.py").write_text(LAB)


@pytest.mark.parametrize("seeds", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_an_agent_learns_from_it(seeds: int, capsys: Capsys) -> None:
    """Trained, validated and tested on its splits; with two seeds other processes import the module, too."""
    words = f"ppo --suite lab:LAB --steps 384 --num-envs 12 --width 8 --seeds {seeds} --validation-episodes 20"
    with pytest.raises(SystemExit) as ended:
        train.typed([*words.split(), "--name", "tiny"])
    assert not ended.value.code
    results = json.loads(Path("runs/tiny/results.json").read_text(encoding="utf-8"))
    assert results["held_out"] == {"suite": "lab-v1", "split": "test", "episodes": 20}
    assert results["settings"]["suite"] == ["lab:LAB"]
    assert {cell["scenario"] for cell in results["cells"]} == {"short", "long"}
    assert "agent (ppo)" in capsys.readouterr().out


def test_a_rule_is_tuned_on_it() -> None:
    rule = policies.get("decimate:every=3")
    task = Task.of(Place(on="lab:LAB"), rule)
    assert (task.on, task.kind, task.capacities) == ("lab-v1", "queue", (4,))
    assert {len(scenarios) for scenarios in task.splits.values()} == {2}


def test_its_kind_says_who_can_learn_it() -> None:
    Path("cells.py").write_text("import bufgym\nTOPICS = bufgym.suite('mine-v1', 'topics', seeds=1)\nNONE = 3\n")
    refuse(
        "suite cells:TOPICS: ppo learns none of this kind; these do: tune RULE", PPO, suites=Suites(("cells:TOPICS",))
    )
    refuse("cells:NONE: must be a suite, as bufgym.suite", Suites, ("cells:NONE",))

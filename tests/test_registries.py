"""Tests leave no trace: what one registers, the next does not find, and a file registers nothing as it is imported."""

import os
import subprocess
import sys
from pathlib import Path

import registries

REPO = Path(__file__).resolve().parent.parent

ONE_AFTER_THE_OTHER = """
import sys
import gymnasium as gym
import pytest
from bufgym import policies, scenario
from bufgym.utils import modules
from bufgym.model.observe import OWN_FIELDS, OWN_TERMS, field, reward_term
from bufgym.scenario import SCENARIOS, Interruption

def registered():
    names = *policies.names(), *OWN_FIELDS, *OWN_TERMS, *SCENARIOS, *gym.registry, *sys.modules
    return {name for name in names if "mine" in name}

@pytest.mark.parametrize("time", [1, 2])
def test(time, tmp_path):
    assert registered() == set() and modules.FILES == [] and "SEEN" not in globals()
    policies.register("mine")(lambda buffer, arrival, memory: 0)
    field("mine_field", per="context")(lambda buffer, arrival: 0.0)
    reward_term("mine_term")(lambda step, memory: 0.0)
    scenario.register("mine-scenario")(Interruption)
    gym.register("mine/Env-v0", entry_point="bufgym.envs:SenderEnv")
    (tmp_path / "mine_module.py").write_text("def decide(buffer, arrival, memory):\\n    return 0\\n")
    modules.find("mine_module:decide", str(tmp_path))
    assert registered() == {"mine", "mine_field", "mine_term", "mine-scenario", "mine/Env-v0", "mine_module"}
"""

AS_IT_IS_IMPORTED = """
from bufgym.policies import register
register("mine")(lambda buffer, arrival, memory: 0)

def test():
    pass
"""


def run(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a file of tests with the project's conftest.py."""
    (folder / "test_made_up.py").write_text(program)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "conftest", "-p", "no:cacheprovider", "-c", "pyproject.toml"]
    path = {"PYTHONPATH": os.pathsep.join([str(REPO), str(REPO / "tests"), *sys.path])}
    return subprocess.run(
        [*command, str(folder / "test_made_up.py")],
        cwd=REPO,
        env=os.environ | path,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_second_test_finds_nothing_of_the_first(tmp_path: Path) -> None:
    done = run(ONE_AFTER_THE_OTHER, tmp_path)
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout


def test_a_file_that_registers_as_it_is_imported_is_refused(tmp_path: Path) -> None:
    done = run(AS_IT_IS_IMPORTED, tmp_path)
    assert done.returncode != 0
    assert "registers as it is imported, and must in a fixture: mine in bufgym.policies.registry" in done.stdout


def test_each_table_is_put_back() -> None:
    tables = registries._copies()
    assert {"bufgym.policies.registry:_REGISTRY", "gymnasium:registry", "bufgym:ENVIRONMENTS"} < {t[0] for t in tables}
    for place, table, before in tables:
        with registries.restored() as changed:
            if isinstance(table, dict):
                table.clear()
                table["mine"] = None
            else:
                table[:] = ["mine"]
        assert registries._same(table, before)
        assert changed == ([f"mine in {place}"] if isinstance(table, dict) else [])

"""A scenario, a link and a V of one's own: by name, as text, checked; and ``bufgym bench`` with them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import bufgym  # noqa: F401  (registers the environments)
from bufgym import scenario
from bufgym.benchmark.rows import read_rows
from bufgym.cli import main
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import SCENARIOS, Episode, Interruption, Uplink, messages, registry
from bufgym.scenario.configuration import read_client
from bufgym.traces import Trace

MODULE = """
import numpy as np
from bufgym import scenario
from bufgym.model import qoi
from bufgym.scenario import Interruption
from bufgym.traces import Trace

def corridor(seed):
    return Trace.steps([(1 + seed, 9e6), (1, 0)], name=f"corridor-{seed}")

def no_link(seed):
    return seed

def doorways(d):
    return d / (d + 0.5)

def rising(d):
    return d * d

def made():
    return qoi.tabulated([0, 1, 4], [0, 0.5, 0.8])

def short():
    return Interruption(t_max=9, law="fixed")
"""

FILE = """
from bufgym import scenario
from bufgym.scenario import Interruption

@scenario.register("nine")
def nine():
    "Interruptions of nine messages."
    return Interruption(t_max=9, law="fixed")
"""


@pytest.fixture(autouse=True)
def clean() -> Iterator[None]:
    before = dict(SCENARIOS)
    yield
    SCENARIOS.clear()
    SCENARIOS.update(before)
    registry._named.cache_clear()


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module of one's own in the current folder."""
    (tmp_path / "own_scenario_module.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return "own_scenario_module"


class Steady:
    """Ten messages over a steady link."""

    value = qoi.exponential(0.5)
    max_messages = 10
    topics = ()

    def draw(self, streams: Any) -> Episode:
        return Episode(messages(np.arange(10) * 100_000, 1_000), Link(Trace.steps([(1.0, 9e6)])))


def test_a_registered_scenario_is_one_like_the_others() -> None:
    scenario.register("steady-ten")(Steady)
    assert SCENARIOS["steady-ten"][1] == "Ten messages over a steady link."
    env = gym.make("bufgym/Uplink-v0", scenario="steady-ten", capacity=2)
    _, info = env.reset(seed=0)
    ended = False
    while not ended:
        _, _, ended, _, info = env.step(env.action_space.sample(info["action_mask"]))
    assert info["arrived"] == 10
    with pytest.raises(BufgymError, match=r"Steady: no parameter 'speed'; it has: none \(it is no dataclass\)"):
        scenario.get("steady-ten", speed=2)
    with pytest.raises(BufgymError, match="scenario 'lte': a built-in scenario has this name"):
        scenario.register("lte")(Steady)
    with pytest.raises(BufgymError, match="without spaces"):
        scenario.register("my scenario")


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ({"draw": None}, r"has no method `draw\(streams\)`"),
        ({"value": 3}, "has no `value`"),
        ({"max_messages": 0}, "has no `max_messages`, a whole number >= 1"),
        ({"topics": None}, "has no `topics`"),
    ],
)
def test_what_a_scenario_must_have(broken: dict[str, Any], message: str) -> None:
    with pytest.raises(BufgymError, match=message):
        scenario.get(type("Broken", (Steady,), broken)())


def test_a_spec_as_text_brings_its_own(module: str) -> None:
    arguments = {"scenario": f"{module}:short", "value": f"{module}:doorways"}
    spec = gym.make("bufgym/Interruption-v0", **arguments).spec  # type: ignore[arg-type]
    assert spec is not None
    rows = gym.make(gym.envs.registration.EnvSpec.from_json(spec.to_json())).unwrapped.rows  # type: ignore[attr-defined]
    assert rows.scenario.t_max == 9 and rows.scenario.value.name == f"{module}:doorways"
    with pytest.raises(BufgymError, match=f"{module}:long: the module {module} has no long"):
        scenario.get(f"{module}:long")
    with pytest.raises(BufgymError, match="no module 'missing_module' in "):
        scenario.get("missing_module:made")


def test_links_from_a_function_of_a_seed(module: str) -> None:
    uplink = Uplink(traces=[f"{module}:corridor:3-5", "lte-synthetic-0"])  # type: ignore[arg-type]
    assert [trace.name for trace in uplink.traces] == ["corridor-3", "corridor-4", "corridor-5", "lte-synthetic-0"]
    assert uplink.traces[0].duration_us == 5_000_000
    assert len(Uplink(traces=f"{module}:corridor").traces) == 8  # type: ignore[arg-type]
    for text, message in (
        (f"{module}:no_link", "for seed 0 it is 0"),
        (f"{module}:corridor:5-3", "needs 1 to 10000 seeds"),
    ):
        with pytest.raises(BufgymError, match=message):
            Uplink(traces=text)  # type: ignore[arg-type]


def test_a_function_as_v() -> None:
    v = qoi.of_function(lambda d: 1 - 0.618**d, "mine")
    truth = qoi.exponential(0.618)
    differences = [v(d) - truth(d) for d in np.linspace(0, 40, 4001)]
    assert -0.002 <= min(differences) and max(differences) <= 1e-12  # straight between points: never above
    half = qoi.of_function(lambda d: d / (d + 0.5))
    assert half(0.5) == pytest.approx(0.5, abs=0.002) and half(1e6) <= 1
    assert Interruption(value=lambda d: min(1.0, d / 4)).value(4.0) == pytest.approx(1)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("v", "message"),
    [
        (lambda d: d * d, r"grows faster|exceed"),
        (lambda d: 0.5 + 0 * d, "V\\(0\\) must be 0"),
        (lambda d: d * math.exp(-d), "V falls"),
        (lambda d: 3 * d / (d + 1), "must not exceed 1"),
        (lambda d: "much", "must be a number"),
        (3, "must be a bufgym.model.qoi Value, a function"),
    ],
)
def test_a_v_that_breaks_a_rule(v: Any, message: str) -> None:
    with pytest.raises(BufgymError, match=message):
        Interruption(value=v)


def test_v_as_text(module: str) -> None:
    assert qoi.parse("tabulated:0=0,1=0.5,4=0.8")(2.5) == pytest.approx(0.65)
    assert qoi.load(f"{module}:made")(4.0) == pytest.approx(0.8)
    assert qoi.load(f"{module}:doorways").name == f"{module}:doorways"
    with pytest.raises(BufgymError, match="must be of the form tabulated:distance=V"):
        qoi.parse("tabulated:0,1")
    with pytest.raises(BufgymError, match=f"V = {module}:rising"):
        qoi.load(f"{module}:rising")


def test_a_configuration_of_a_stranger_imports_nothing(module: str, tmp_path: Path) -> None:
    file = tmp_path / "client.toml"
    topic = f'[[topic]]\nname = "a"\nrate_hz = 1\nsize_bytes = 1\nvalue = "{module}:made"\n'
    file.write_text(topic)
    with pytest.raises(BufgymError, match="unknown kind"):
        read_client(file)


def test_bench_with_a_scenario_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "mine.py", tmp_path / "out"
    file.write_text(FILE)
    command = [
        "bench",
        "--scenario-file",
        str(file),
        "--policies",
        "afr,drop-oldest",
        "--capacity",
        "2",
        "--seeds",
        "2",
    ]
    assert main([*command, "--out", str(out), "--format", "csv"]) == 0
    assert "Scenario nine: Interruptions of nine messages." in capsys.readouterr().out
    assert {row["arrived"] for row in read_rows(out / "rows.csv")} == {11}
    for more, message in (
        (["--fps", "10"], "--fps cannot go with a scenario of your own"),
        (["--suite", "lte-v1"], "--scenario-file cannot go with --suite"),
        (["--scenario", "ten"], "unknown scenario 'ten'"),
    ):
        assert main([*command, *more]) == 2
        assert message in capsys.readouterr().err
    file.write_text(FILE + "\nraise RuntimeError('no')\n")
    assert main(command) == 2
    assert capsys.readouterr().err == f"bufgym: error: {file}, line 10: RuntimeError: no\n"
    file.write_text("")
    assert main(command) == 2
    assert "registers no scenario" in capsys.readouterr().err


def test_bench_with_modules(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    quick = ["--policies", "afr", "--capacity", "2", "--seeds", "1"]
    assert main(["bench", "--scenario", f"{module}:short", *quick]) == 0
    links = ["--trace", f"{module}:corridor:1-2", "--value", f"{module}:doorways", "--seconds", "1"]
    assert main(["bench", *links, *quick]) == 0
    shown = capsys.readouterr().out
    assert "over corridor-1, corridor-2" in shown and f"V = {module}:doorways" in shown

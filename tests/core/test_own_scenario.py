"""A scenario, a link and a V of one's own: by name, as text, checked; and ``bufgym bench`` with them."""

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from refusal_cases import refuse

import bufgym  # noqa: F401  (registers the environments)
from bufgym import scenario
from bufgym.benchmark.rows import read_rows
from bufgym.cli import main
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import SCENARIOS, Episode, Interruption, Uplink, messages
from bufgym.scenario.client import read_client
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

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
    env = gym.make("bufgym/Uplink-v1", scenario="steady-ten", capacity=2, actions="slots")
    _, info = env.reset(seed=0)
    ended = False
    while not ended:
        _, _, ended, _, info = env.step(env.action_space.sample(info["action_mask"]))
    assert info["arrived"] == 10
    with pytest.raises(BufgymError, match=r"Steady: unknown parameter 'speed'; known: none \(it is no dataclass\)"):
        scenario.get("steady-ten", speed=2)


def test_a_spec_as_text_brings_its_own(module: str) -> None:
    arguments = {"scenario": f"{module}:short", "value": f"{module}:doorways"}
    spec = gym.make("bufgym/Interruption-v1", **arguments, actions="slots").spec  # type: ignore[arg-type]
    assert spec is not None
    sub_envs = gym.make(gym.envs.registration.EnvSpec.from_json(spec.to_json())).unwrapped.sub_envs  # type: ignore[attr-defined]
    assert sub_envs.scenario.t_max == 9 and sub_envs.scenario.value.name == f"{module}:doorways"


def test_links_from_a_function_of_a_seed(module: str) -> None:
    uplink = Uplink(traces=[f"{module}:corridor:3-5", "lte-synthetic-0"])  # type: ignore[arg-type]
    assert [trace.name for trace in uplink.traces] == ["corridor-3", "corridor-4", "corridor-5", "lte-synthetic-0"]
    assert uplink.traces[0].duration_us == 5_000_000
    assert len(Uplink(traces=f"{module}:corridor").traces) == 8  # type: ignore[arg-type]


def test_a_function_as_v() -> None:
    v = qoi.of_function(lambda d: 1 - 0.618**d, "mine")
    truth = qoi.exponential(0.618)
    differences = [v(d) - truth(d) for d in np.linspace(0, 40, 4001)]
    assert -0.002 <= min(differences) and max(differences) <= 1e-12  # straight between points: never above
    half = qoi.of_function(lambda d: d / (d + 0.5))
    assert half(0.5) == pytest.approx(0.5, abs=0.002) and half(1e6) <= 1
    assert Interruption(value=lambda d: min(1.0, d / 4)).value(4.0) == pytest.approx(1)  # type: ignore[arg-type]


def test_v_as_text(module: str) -> None:
    assert qoi.parse("tabulated:0=0,1=0.5,4=0.8")(2.5) == pytest.approx(0.65)
    assert qoi.load(f"{module}:made")(4.0) == pytest.approx(0.8)
    assert qoi.load(f"{module}:doorways").name == f"{module}:doorways"


def no_scenario(**broken: Any) -> Any:
    return scenario.get(type("Broken", (Steady,), broken)())


def configuration(value: str) -> Any:
    """A client's file, which names no module that would be imported."""
    Path("client.toml").write_text(f'[[topic]]\nname = "a"\nrate_hz = 1\nsize_bytes = 1\nvalue = "{value}"\n')
    return read_client(Path("client.toml"))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda _: scenario.register("lte")(Steady), "scenario 'lte': a built-in scenario has this name"),
        (lambda _: scenario.register("my scenario"), "without spaces"),
        (lambda _: no_scenario(draw=None), r"has no method `draw\(streams\)`"),
        (lambda _: no_scenario(value=3), "has no `value`"),
        (lambda _: no_scenario(max_messages=0), "has no `max_messages`, a whole number >= 1"),
        (lambda _: no_scenario(topics=None), "has no `topics`"),
        (lambda m: scenario.get(f"{m}:long"), "own_scenario_module:long: the module own_scenario_module has no long"),
        (lambda _: scenario.get("missing_module:made"), "no module 'missing_module' in "),
        (lambda m: Uplink(traces=f"{m}:no_link"), "for seed 0 it is 0"),
        (lambda m: Uplink(traces=f"{m}:corridor:5-3"), "needs 1 to 10000 seeds"),
        (lambda _: Interruption(value=lambda d: d * d), r"grows faster|exceed"),
        (lambda _: Interruption(value=lambda d: 0.5 + 0 * d), r"V\(0\) must be 0"),
        (lambda _: Interruption(value=lambda d: d * math.exp(-d)), "V falls"),
        (lambda _: Interruption(value=lambda d: 3 * d / (d + 1)), "must not exceed 1"),
        (lambda _: Interruption(value=lambda d: "much"), "must be a number"),
        (lambda _: Interruption(value=3), "must be a bufgym.model.qoi Value, a function"),
        (lambda _: qoi.parse("tabulated:0,1"), "must be of the form tabulated:distance=V"),
        (lambda m: qoi.load(f"{m}:rising"), "V = own_scenario_module:rising"),
        (lambda m: configuration(f"{m}:made"), "unknown kind"),
    ],
)
def test_what_is_refused(module: str, build: Any, message: str) -> None:
    refuse(message, build, module)


def test_bench_with_a_file_and_with_modules(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    file, quick = Path("mine.py"), ["--policies", "afr", "--capacity", "2", "--seeds", "2"]
    file.write_text(FILE)
    command = ["bench", "--scenario-file", str(file), *quick]
    assert main([*command, "--out", "out", "--format", "csv"]) == 0
    assert "Scenario nine: Interruptions of nine messages." in capsys.readouterr().out
    assert {row["arrived"] for row in read_rows(Path("out/rows.csv"))} == {11}
    links = ["--trace", f"{module}:corridor:1-2", "--value", f"{module}:doorways", "--seconds", "1"]
    assert main(["bench", *links, *quick]) == 0
    shown = capsys.readouterr().out
    assert "over corridor-1, corridor-2" in shown and f"V = {module}:doorways" in shown
    for more, message in (
        (["--motion", "none"], "--motion cannot go with nine, which has no such parameter"),
        (["--suite", "lte-v1"], "--scenario-file cannot go with --suite"),
    ):
        assert main([*command, *more]) == 2
        assert message in capsys.readouterr().err
    for text, message in (
        (FILE + "\nraise RuntimeError('no')\n", f"error: {file}, line 10: RuntimeError: no\n"),
        ("", "registers no scenario"),
    ):
        file.write_text(text)
        assert main(command) == 2
        assert message in capsys.readouterr().err

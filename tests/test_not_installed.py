"""What is not installed says where it is: commands and environments of other packages, and the libraries of extras."""

import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoints
from pathlib import Path

import gymnasium as gym
import pytest
from cli_cases import Capsys, Patch, fails, shown

from bufgym import cli
from bufgym.utils import packages
from bufgym.utils.errors import BufgymError

REPO = Path(__file__).resolve().parent.parent
COMMANDS = {
    "live": ["robot"],
    "ros2": ["robot"],
    "robot": ["robot"],
    "relay": ["robot", "relay"],
    "reproduce": ["papers"],
}
"""Command -> the folder of the package that has it, last, behind those of the packages that it needs."""


@pytest.fixture
def bare(monkeypatch: Patch) -> None:
    """The core alone is installed."""
    monkeypatch.setattr(cli, "entry_points", lambda group: EntryPoints())


@pytest.fixture
def wheel(monkeypatch: Patch, tmp_path: Path) -> None:
    """It came as a wheel, which holds no folder ``packages``."""
    settings = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))
    for source, target in settings["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"].items():
        if (REPO / source).is_file():
            (tmp_path / target).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(REPO / source, tmp_path / target)
    monkeypatch.setattr(packages, "PACKAGE", tmp_path / "bufgym")


def test_a_command_of_a_package_is_told_in_a_checkout(bare: None, capsys: Capsys) -> None:
    assert "live" not in shown(["--help"], capsys)
    for command, names in COMMANDS.items():
        folders = " ".join(f"-e {REPO / 'packages' / name}" for name in names)
        fails([command, "send"], f"{command} comes with the package bufgym-{names[-1]}: pip install {folders}", capsys)
    fails(
        ["export", "afr", "x.h", "--to", "c"],
        "With more options export comes with the package bufgym-robot: pip install",
        capsys,
    )
    fails(["nonsense"], 'Unknown command "nonsense"', capsys)


def test_so_it_is_by_a_wheel(bare: None, wheel: None, capsys: Capsys) -> None:
    for command, names in COMMANDS.items():
        folders = " ".join(f"packages/{name}" for name in names)
        where = f"bufgym-{names[-1]}: pip install {folders}, in bufgym's source tree"
        fails([command], f"{command} comes with the package {where}", capsys)


def test_a_wheel_carries_what_every_package_declares(wheel: None) -> None:
    carried = packages.PACKAGE / "data" / "packages"
    assert {f.stem for f in carried.iterdir()} == {f.parent.name for f in REPO.glob("packages/*/pyproject.toml")}


def test_training_is_told(capsys: Capsys) -> None:
    fails(["train"], 'type there "make train", or "python train.py', capsys)


def test_an_environment_of_a_package_is_told_when_it_is_made(monkeypatch: Patch) -> None:
    """In a fresh process without any package; ``list`` shows only what can be made."""
    program = """
import importlib.metadata
importlib.metadata.entry_points = lambda group: importlib.metadata.EntryPoints()
import gymnasium as gym, bufgym
from bufgym.cli.listing import environments
print(*environments())
for make in (gym.make, gym.make_vec):
    try:
        make("bufgym/Mapping-v0", capacity=3)
    except bufgym.BufgymError as error:
        print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=REPO, capture_output=True, text=True, check=True)
    listed, *fault = done.stdout.splitlines()
    assert "bufgym/Uplink-v1" in listed and "bufgym/Mapping-v0" not in listed
    command = f"pip install -e {REPO / 'packages' / 'papers'}"
    assert fault == [f"bufgym/Mapping-v0 comes with the package bufgym-papers: {command}"] * 2


def test_a_stand_in_takes_any_argument() -> None:
    with pytest.raises(BufgymError, match="there"):
        packages.raise_absent("there", num_envs=3, render_mode="human")
    assert "fault" not in gym.spec("bufgym/Uplink-v1").kwargs


WITHOUT_EXTRAS = """
import importlib.abc, io, re, sys
from contextlib import redirect_stdout
from importlib import metadata

needed, waiting = set(), ["bufgym", "bufgym-robot", "bufgym-papers"]
while waiting:
    name = re.sub(r"[-_.]+", "-", waiting.pop()).lower()
    if name not in needed:
        try:
            required = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        needed.add(name)
        waiting += [re.match(r"[\\w.-]+", text)[0] for text in required if "extra ==" not in text]

def is_needed(distributions):
    return any(re.sub(r"[-_.]+", "-", name).lower() in needed for name in distributions)

tops = metadata.packages_distributions().items()
optional = {top for top, of in tops if not is_needed(of) and not top.startswith("bufgym")}
assert {"msgspec", "torch", "jinja2"} & optional, sorted(needed)

class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in optional:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
"""
"""Every library that comes with extras alone is hidden, whichever machine this is."""


def test_every_help_works_without_extras() -> None:
    program = (
        WITHOUT_EXTRAS
        + """
from bufgym import cli

def below(commands, *words):
    yield words
    for name, what in commands.items():
        if isinstance(what, str):
            yield (*words, name)
        else:
            yield from below(what[1], *words, name)

every = cli.COMMANDS | {entry.name: entry.load() for entry in metadata.entry_points(group=cli.GROUP)}
for words in below(every):
    with redirect_stdout(io.StringIO()) as fault:
        code = cli.main([*words, "--help"])
    assert code == 0 and fault.getvalue().startswith("Usage: bufgym"), words
    print(*words)
for words in (["export", "own.py", "own.safetensors", "--name", "own"], ["robot", "--bag", "x.mcap"]):
    assert cli.main(words) == 2
"""
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=REPO, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {"bench", "trace from-bag", "relay serve", "robot", "live send", "reproduce"} <= set(
        done.stdout.splitlines()
    )
    export, robot = done.stderr.splitlines()
    assert "bufgym.sb3 needs torch: pip install" in export and "[train]" in export
    assert "bufgym robot needs msgspec: pip install" in robot and "[relay]" in robot

"""The house rules: paths, cheap imports, hints; packages beside the core. `lint-imports` knows the layers."""

import ast
import importlib
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from cli_cases import Capsys, Patch, shown
from needs import needs

import bufgym
from bufgym import cli
from bufgym.utils import errors

REPO = Path(__file__).resolve().parent.parent


def test_no_text_file_holds_a_path_of_one_machine() -> None:
    """A path into a top folder where people and build machines keep checkouts holds on one machine only."""
    homes = r"(?<![\w.~$*)}>-])/(?:home|root|Users|work|workspaces?|builds)/[\w.-]+|\b[A-Za-z]:\\+Users\\"
    search = ["git", "grep", "--untracked", "-nIP", homes]
    found = subprocess.run(search, cwd=REPO, capture_output=True, text=True, check=False)
    if found.returncode > 1:
        pytest.skip(needs("git"))
    assert not found.stdout


def test_one_version_everywhere() -> None:
    version = bufgym.__version__
    settings = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))
    assert settings["tool"]["hatch"]["version"]["path"] == "bufgym/utils/__init__.py"
    assert f"\nversion: {version}\n" in (REPO / "CITATION.cff").read_text(encoding="utf-8")
    try:
        installed = importlib.metadata.version("bufgym")
    except importlib.metadata.PackageNotFoundError:
        return  # run from the source tree alone
    assert installed == version


HEAVY = ("torch", "stable_baselines3", "sb3_contrib", "matplotlib", "scipy", "pandas", "pyarrow", "cv2", "rvl")


def output_of(program: str) -> str:
    done = subprocess.run([sys.executable, "-c", program], cwd=REPO, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("package", ["bufgym", "bufgym.model", "bufgym.envs", "bufgym.traces"])
def test_a_package_that_loads_on_demand_has_no_other_name(package: str) -> None:
    module = importlib.import_module(package)
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'no_such_name'"):
        getattr(module, "no_such_name")  # noqa: B009  (mypy knows that it is missing)


NEEDED_LATER = (
    "asyncio", "cyclopts", "difflib", "filelock", "joblib", "pooch", "requests", "safetensors",
    "sqlite3", "ssl", "tqdm",
)  # fmt: skip
"""What a first step does without, of Python and of libraries."""
MADE = "'bufgym/Uplink-v1', capacity=8"
FIRST = {
    "import": "",
    "step": f"e = gymnasium.make({MADE}); e.reset(seed=0); e.step(0)",
    "batch": f"e = gymnasium.make_vec({MADE}, num_envs=2); e.reset(seed=0); e.step(e.action_space.sample())",
    "compare": "print(bufgym.compare(['afr', 'drop-oldest'], 'lte', seeds=1, duration_s=0.2), file=sys.stderr)",
}


@pytest.mark.parametrize("program", FIRST.values(), ids=FIRST)
def test_a_first_step_imports_nothing_heavy(program: str) -> None:
    """What core dependencies bring is not bufgym's doing."""
    unwanted = set(HEAVY + NEEDED_LATER)
    before = "import sys, numpy, gymnasium; core = {*sys.modules}; import bufgym"
    after = f"{{m for m in {{*sys.modules}} - core if m.split('.')[0] in {unwanted!r}}}"
    extra = output_of(f"{before}\n{program}\nprint(*{after})").split()
    assert not extra, f"it also imports {sorted(extra)[:5]}"


def test_sb3_without_its_extra_names_it() -> None:
    """``stable_baselines3`` set to None cannot be imported, as if it were not installed."""
    program = (
        "import sys\nsys.modules['stable_baselines3'] = None\n"
        "from bufgym.utils.errors import BufgymError\n"
        "try:\n    import bufgym.sb3\nexcept BufgymError as error:\n    print(error)"
    )
    printed = output_of(program)
    assert printed.startswith("bufgym.sb3 needs ") and printed.strip().endswith('pip install "bufgym[train]"')


def test_a_hint_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """pip finds it in the bufgym that is installed; a source tree is installed with it."""
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.2.0")
    assert errors.install("plot") == 'pip install "bufgym[plot]"'
    assert errors.install("bufgym-robot[relay]") == 'pip install "bufgym-robot[relay]"'
    monkeypatch.setattr(importlib.metadata, "version", importlib.metadata.distribution)
    monkeypatch.setattr(importlib.metadata.Distribution, "discover", lambda **_: iter(()))
    assert errors.install("plot") == 'pip install -e ".[plot]"'
    assert errors.install("bufgym-robot[relay]") == 'pip install -e "packages/robot[relay]"'


def test_every_hint_names_an_extra_that_there_is() -> None:
    extras = set()
    for file in (REPO / "pyproject.toml", *(REPO / "packages").glob("*/pyproject.toml")):
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        name = project["name"]
        extras |= {extra if name == "bufgym" else f"{name}[{extra}]" for extra in project["optional-dependencies"]}
    places, named = {"install": 0, "needs": 1, "library": 1, "missing": 2}, set()
    sources = [REPO / "bufgym", *(REPO / "packages").glob("*/bufgym_*")]
    for path in sorted(path for folder in sources for path in folder.rglob("*.py")):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in places:
                words = call.args[places[call.func.id] :][:1]
                named |= {word.value for word in words if isinstance(word, ast.Constant)}
    assert {"plot", "train", "fleet", "ros", "bufgym-robot[relay]"} <= named <= extras


PACKAGES = {file.parent.name: file for file in sorted((REPO / "packages").glob("*/pyproject.toml"))}


def declared(name: str) -> dict[str, Any]:
    project: dict[str, Any] = tomllib.loads(PACKAGES[name].read_text(encoding="utf-8"))["project"]
    return project


def functions(what: Any) -> list[str]:
    """Where the functions of a command and of the commands below it are."""
    return [what] if isinstance(what, str) else [place for below in what[1].values() for place in functions(below)]


def test_the_core_names_no_package() -> None:
    """Were one of them taken away, no line of the core would have to change."""
    sources = [path for path in (REPO / "bufgym").rglob("*") if path.suffix in (".py", ".toml", ".json", ".html")]
    assert REPO / "bufgym" / "__init__.py" in sources
    names = re.compile("|".join(f"bufgym[_-]{name}" for name in PACKAGES))
    assert not [path for path in sources if names.search(path.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("name", PACKAGES)
def test_a_package_has_the_version_of_the_core_and_what_it_declares(name: str) -> None:
    package = importlib.import_module(f"bufgym_{name}")
    assert package.__version__ == bufgym.__version__ and declared(name)["name"] == f"bufgym-{name}"
    for group, entries in declared(name)["entry-points"].items():
        for entry, place in entries.items():
            what = EntryPoint(entry, place, group).load()
            if group == cli.GROUP:
                for module, _, function in (text.partition(":") for text in functions(what)):
                    assert callable(getattr(importlib.import_module(module), function))
            else:
                assert what[2].items() <= gym.registry[entry].kwargs.items()


def test_a_package_of_your_own_adds_a_command(monkeypatch: Patch, capsys: Capsys, tmp_path: Path) -> None:
    (tmp_path / "of_mine.py").write_text('HELLO = "of_mine:hello"\n\ndef hello(name: str) -> None:\n    print(name)\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    mine = EntryPoints([EntryPoint("hello", "of_mine:HELLO", cli.GROUP)])
    monkeypatch.setattr(cli, "entry_points", lambda group: mine)
    assert shown(["hello", "you"], capsys) == "you\n"

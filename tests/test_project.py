"""The house rules: rooms import only from rooms above, paths are relative, importing bufgym stays cheap."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parent.parent

# -------------------- (a) import order

ROOMS = [
    "errors",
    "files",
    "modules",
    "kernel",
    "traces",
    "model",
    "observe",
    "policies",
    "scenario",
    "sim",
    "oracle",
    "live",
    "perception",
    "c",
    "envs",
    "expert",
    "sb3",
    "benchmark",
    "ros1",
    "ros2",
    "relay",
    "reproduce",
    "gallery",
    "cli",
    "__main__",
]
"""The rooms of the house, top to bottom. Each imports only from itself and from rooms above it."""

OUTSIDE = {"agents", "train", "tests", "website"}
"""What imports bufgym, and is never imported by it."""

TRAINING = [
    "agents.settings",
    "agents.runs",
    "agents.mixed_env",
    "agents.evaluation",
    "agents.held_out",
    "agents.figure",
    "agents.objectives.objective",
    "agents.objectives.queue",
    "agents.objectives.topics",
    "agents.objectives.fleet",
    "agents.objectives",
    "agents.cma_es",
    "agents.callbacks",
    "agents.dqn",
    "agents.training",
    "agents.page",
    "agents.report",
    "agents.goals",
    "agents.scheduling",
    "agents.on_task",
    "agents.ablation",
    "agents.small_queue",
    "train",
]
"""The modules that drive training, top to bottom. Each imports only bufgym and modules above it."""


def imported_names(tree: ast.Module, module: str, is_package: bool) -> Iterator[tuple[int, str]]:
    """Each (line, full dotted name) that a module imports: at the top, in a function, or for types only."""
    package = module.split(".") if is_package else module.split(".")[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            prefix = ".".join([*base, *([node.module] if node.module else [])])
            for alias in node.names:
                yield node.lineno, f"{prefix}.{alias.name}"


def faults(source: str, module: str, is_package: bool = False) -> list[str]:
    """What in one module's imports breaks the order of the rooms, a sentence each."""
    room = module.split(".")[1]
    if room not in ROOMS:
        return [f"{module}: room '{room}' has no place in ROOMS; give it one"]
    found = []
    for line, name in imported_names(ast.parse(source), module, is_package):
        top, *rest = name.split(".")
        if top in OUTSIDE:
            found.append(f"{module}:{line}: bufgym never imports {top}")
        elif top == "bufgym" and rest != ["__version__"]:
            if not rest or rest[0] not in ROOMS:
                found.append(f"{module}:{line}: imports {name}: name a room, not the whole package")
            elif ROOMS.index(rest[0]) > ROOMS.index(room):
                found.append(f"{module}:{line}: imports {rest[0]}, which is below {room}")
    return found


def training_faults(source: str, module: str) -> list[str]:
    """What in the imports of one module of TRAINING breaks their order, a sentence each."""
    if module not in TRAINING:
        return [f"{module}: has no place in TRAINING; give it one"]
    found = []
    for line, name in imported_names(ast.parse(source), module, is_package=False):
        if name.split(".")[0] not in OUTSIDE:
            if name.startswith("importlib.import_module"):
                found.append(f"{module}:{line}: import_module hides what is imported")
            continue
        # The longest module that the name begins with: "agents.objectives.queue.start" is of that module.
        owners = [other for other in TRAINING if f"{name}.".startswith(f"{other}.")]
        if not owners:
            found.append(f"{module}:{line}: imports {name}, which has no place in TRAINING")
        elif TRAINING.index(max(owners, key=len)) >= TRAINING.index(module):
            found.append(f"{module}:{line}: imports {max(owners, key=len)}, which is not above {module}")
    return found


def training_modules() -> dict[str, Path]:
    """Dotted name -> file of train.py and every module in agents but ``agents/__init__.py``."""
    paths = [*sorted((REPO / "agents").rglob("*.py")), REPO / "train.py"]
    names = [".".join(path.relative_to(REPO).with_suffix("").parts).removesuffix(".__init__") for path in paths]
    return {name: path for name, path in zip(names, paths, strict=True) if name != "agents"}


@pytest.mark.parametrize("module", training_modules())
def test_each_module_of_training_imports_only_what_is_above_it(module: str) -> None:
    faults_found = training_faults(training_modules()[module].read_text(encoding="utf-8"), module)
    assert not faults_found, "\n".join(faults_found)


@pytest.mark.parametrize(
    ("module", "source", "fault"),
    [
        ("agents.training", "from agents.runs import Run", ""),
        ("agents.training", "from agents import cma_es", ""),
        ("train", "def main():\n    from agents import report, training", ""),
        ("agents.runs", "from agents import training", "agents.training, which is not above"),
        ("agents.runs", "def lazy():\n    from agents.report import report", "agents.report, which is not above"),
        ("agents.settings", "from train import main", "train, which is not above"),
        ("agents.objectives.queue", "from agents.objectives.fleet import widened", "which is not above"),
        ("agents.runs", "from importlib import import_module", "hides"),
        ("agents.runs", "from agents.attic import old", "has no place"),
        ("agents.attic", "", "has no place"),
    ],
)
def test_the_check_of_training_finds_what_it_should(module: str, source: str, fault: str) -> None:
    sentences = training_faults(source, module)
    assert len(sentences) == bool(fault)
    assert all(fault in sentence for sentence in sentences)


def modules() -> dict[str, Path]:
    """Dotted name -> file of every module in bufgym but ``bufgym/__init__.py``, which may import them all."""
    found = {}
    for path in sorted((REPO / "bufgym").rglob("*.py")):
        parts = path.relative_to(REPO).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name != "bufgym":
            found[name] = path
    return found


@pytest.mark.parametrize("module", modules())
def test_each_room_imports_only_from_rooms_above(module: str) -> None:
    path = modules()[module]
    found = faults(path.read_text(encoding="utf-8"), module, is_package=path.name == "__init__.py")
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "source", "fault"),
    [
        ("bufgym.model", "from bufgym.traces.trace import Trace", ""),
        ("bufgym.model.link", "from bufgym import traces, __version__", ""),
        ("bufgym.model", "import numpy as np", ""),
        ("bufgym.envs.single", "from .vector import Batch", ""),
        ("bufgym.envs.single", "from ..sim import step", ""),
        ("bufgym.model.link", "from bufgym.sim import step", "below model"),
        ("bufgym.model", "def lazy():\n    import bufgym.envs.single", "below model"),
        ("bufgym.model", "from bufgym import traces, envs", "below model"),
        ("bufgym.policies.afr", "from ..sim import step", "below policies"),
        ("bufgym.model", "import bufgym", "not the whole package"),
        ("bufgym.model", "from bufgym import *", "not the whole package"),
        ("bufgym.sb3", "from agents.cma_es import Evolution", "never imports agents"),
        ("bufgym.attic", "", "has no place"),
    ],
)
def test_the_order_check_finds_what_it_should(module: str, source: str, fault: str) -> None:
    found = faults(source, module)
    assert len(found) == bool(fault)
    assert all(fault in sentence for sentence in found)


# -------------------- (b) paths

HOMES = ["home", "root", "Users", "work", "workspace", "workspaces", "builds"]
"""Top folders where people and build machines keep checkouts: a path into one holds on one machine only."""

ABSOLUTE = re.compile(rf"(?<![\w.~$*)}}>-])/(?:{'|'.join(HOMES)})/[\w.-]+|\b[A-Za-z]:\\+Users\\")


def tracked_files() -> list[Path]:
    """Every file that git tracks or would offer to track; outside a git checkout, all but what was built."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=REPO,
            capture_output=True,
            check=True,
        ).stdout
        paths = [REPO / name for name in listed.decode().split("\0") if name]
    except (OSError, subprocess.CalledProcessError):
        skip = {".venv", ".git", "build", "dist", "runs", "results", "__pycache__"}
        paths = [
            path
            for path in REPO.rglob("*")
            if not any(part in skip or part.endswith("_cache") for part in path.relative_to(REPO).parts)
        ]
    return [path for path in paths if path.is_file()]


def test_no_text_file_holds_a_path_of_one_machine() -> None:
    found = []
    for path in tracked_files():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue  # not text
        found += [f"{path.relative_to(REPO)}: {match.group()}" for match in ABSOLUTE.finditer(text)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("top", HOMES)
def test_the_path_check_finds_what_it_should(top: str) -> None:
    assert ABSOLUTE.search(f"see /{top}/robot/log.txt")
    assert ABSOLUTE.search(f'open("/{top}/robot")')
    assert not ABSOLUTE.search(f"maps/{top}/robot, ~/{top}/robot, $ROOT/{top}/robot, ${{ROOT}}/{top}/robot")


# -------------------- (c) version


def test_one_version_everywhere() -> None:
    import bufgym  # here, so that a package that is broken fails this test alone

    version = bufgym.__version__
    settings = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))
    assert settings["tool"]["hatch"]["version"]["path"] == "bufgym/__init__.py"
    assert f"\nversion: {version}\n" in (REPO / "CITATION.cff").read_text(encoding="utf-8")
    try:
        installed = importlib.metadata.version("bufgym")
    except importlib.metadata.PackageNotFoundError:
        return  # run from the source tree alone
    assert installed == version


# -------------------- (d) light import

HEAVY = ("torch", "stable_baselines3", "sb3_contrib", "matplotlib", "scipy", "pandas", "pyarrow", "cv2", "rvl")


def heavy_modules_after(statement: str) -> set[str]:
    """Every module of the heavy packages that a fresh interpreter holds after one statement."""
    program = f"{statement}\nimport sys\nprint(*[m for m in sys.modules if m.split('.')[0] in {HEAVY!r}])"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def test_importing_bufgym_imports_nothing_heavy() -> None:
    # Numba itself opens scipy where that is installed: what core dependencies bring is not bufgym's doing.
    core = heavy_modules_after("import numpy, gymnasium, numba")
    extra = heavy_modules_after("import bufgym") - core
    assert not extra, f"import bufgym also imports {sorted(extra)[:5]}"


def test_sb3_without_its_extra_names_it() -> None:
    """``stable_baselines3`` set to None cannot be imported, as if it were not installed."""
    program = (
        "import sys\nsys.modules['stable_baselines3'] = None\n"
        "from bufgym.errors import BufgymError\n"
        "try:\n    import bufgym.sb3\nexcept BufgymError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=REPO, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (
        done.stdout.startswith("bufgym.sb3 needs ") and "stable-baselines3" in done.stdout.partition("pip install ")[2]
    )

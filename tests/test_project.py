"""The house rules: rooms import only from rooms above, paths are relative, importing stays cheap, hints name extras."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from bufgym import errors

REPO = Path(__file__).resolve().parent.parent

_ROOMS = """
    errors files modules kernel traces model observe policies scenario sim oracle live perception c envs expert sb3
    benchmark ros1 ros2 relay reproduce gallery cli __main__
"""
ROOMS = _ROOMS.split()
"""The rooms of the house, top to bottom. Each imports only from itself and from rooms above it."""

_TRAINING = """
    agents.settings agents.runs agents.mixed_env agents.evaluation agents.held_out agents.figure
    agents.objectives.objective agents.objectives.queue agents.objectives.topics agents.objectives.fleet
    agents.objectives agents.cma_es agents.callbacks agents.dqn agents.training agents.page agents.report agents.goals
    agents.scheduling agents.on_task agents.ablation agents.small_queue train
"""
TRAINING = _TRAINING.split()
"""The modules that drive training, top to bottom. Each imports only bufgym and modules above it."""

OUTSIDE = {"agents", "train", "tests", "website"}
"""What imports bufgym, and is never imported by it."""


def imported_names(path: Path, module: str) -> Iterator[tuple[str, str]]:
    """Each (file and line, full dotted name) that a module imports: at the top, in a function, or for types only."""
    package = module.split(".")[: None if path.name == "__init__.py" else -1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((f"{module}:{node.lineno}", alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            prefix = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((f"{module}:{node.lineno}", f"{prefix}.{alias.name}") for alias in node.names)


def modules(*folders: str) -> dict[str, Path]:
    """Dotted name -> file of every module under the folders, but for their own ``__init__.py``."""
    paths = [path for folder in folders for path in sorted(REPO.glob(folder))]
    names = [".".join(path.relative_to(REPO).with_suffix("").parts).removesuffix(".__init__") for path in paths]
    return {name: path for name, path in zip(names, paths, strict=True) if name not in ("bufgym", "agents")}


def test_each_room_imports_only_from_rooms_above() -> None:
    found = modules("bufgym/**/*.py")
    assert {name.split(".")[1] for name in found} == set(ROOMS)
    faults = []
    for module, path in found.items():
        room = module.split(".")[1]
        for where, name in imported_names(path, module):
            top, *rest = name.split(".")
            if top in OUTSIDE:
                faults.append(f"{where}: bufgym never imports {top}")
            elif top == "bufgym" and rest != ["__version__"]:
                if not rest or rest[0] not in ROOMS:
                    faults.append(f"{where}: imports {name}: name a room, not the whole package")
                elif ROOMS.index(rest[0]) > ROOMS.index(room):
                    faults.append(f"{where}: imports {rest[0]}, which is below {room}")
    assert not faults, "\n".join(faults)


def test_each_module_of_training_imports_only_what_is_above_it() -> None:
    found = modules("agents/**/*.py", "train.py")
    assert set(found) == set(TRAINING)
    faults = []
    for module, path in found.items():
        for where, name in imported_names(path, module):
            # The longest module that the name begins with: "agents.objectives.queue.start" is of that module.
            owner = max((other for other in TRAINING if f"{name}.".startswith(f"{other}.")), key=len, default=None)
            if name.split(".")[0] in OUTSIDE and (owner is None or TRAINING.index(owner) >= TRAINING.index(module)):
                faults.append(f"{where}: imports {name}, which is not above {module}")
            elif name.startswith("importlib.import_module"):
                faults.append(f"{where}: import_module hides what is imported")
    assert not faults, "\n".join(faults)


HOMES = ["home", "root", "Users", "work", "workspace", "workspaces", "builds"]
"""Top folders where people and build machines keep checkouts: a path into one holds on one machine only."""

ABSOLUTE = re.compile(rf"(?<![\w.~$*)}}>-])/(?:{'|'.join(HOMES)})/[\w.-]+|\b[A-Za-z]:\\+Users\\")


def tracked_files() -> list[Path]:
    """Every file that git tracks or would offer to track; outside a git checkout, all but what was built."""
    git = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(git, cwd=REPO, capture_output=True, check=True).stdout
        paths = [REPO / name for name in listed.decode().split("\0") if name]
    except (OSError, subprocess.CalledProcessError):
        built = re.compile(r"(^|/)(\.venv|\.git|build|dist|runs|results|__pycache__|[^/]*_cache)/")
        paths = [path for path in REPO.rglob("*") if not built.search(path.relative_to(REPO).as_posix())]
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


HEAVY = ("torch", "stable_baselines3", "sb3_contrib", "matplotlib", "scipy", "pandas", "pyarrow", "cv2", "rvl")


def output_of(program: str) -> str:
    done = subprocess.run([sys.executable, "-c", program], cwd=REPO, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_bufgym_imports_nothing_heavy() -> None:
    """Numba itself opens scipy where that is installed: what core dependencies bring is not bufgym's doing."""
    before = "import sys, numpy, gymnasium, numba; core = {*sys.modules}; import bufgym"
    extra = output_of(f"{before}; print(*[m for m in {{*sys.modules}} - core if m.split('.')[0] in {HEAVY!r}])").split()
    assert not extra, f"import bufgym also imports {sorted(extra)[:5]}"


def test_sb3_without_its_extra_names_it() -> None:
    """``stable_baselines3`` set to None cannot be imported, as if it were not installed."""
    program = (
        "import sys\nsys.modules['stable_baselines3'] = None\n"
        "from bufgym.errors import BufgymError\n"
        "try:\n    import bufgym.sb3\nexcept BufgymError as error:\n    print(error)"
    )
    told = output_of(program)
    assert told.startswith("bufgym.sb3 needs ") and "stable-baselines3" in told.partition("pip install ")[2]


REQUIRES = ["numpy>=2.1", 'matplotlib; extra == "plot"', 'mcap<2,>=1.2; extra == "ros"']
REQUIRES += ['flatbuffers; extra == "robofleet"', 'bufgym[ros]; extra == "robofleet"']


def test_a_hint_names_the_packages_of_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: REQUIRES)
    assert errors.install("plot") == "pip install matplotlib"
    # What a shell would take for a redirection is quoted, and an extra of bufgym's own is written out.
    assert errors.install("robofleet") == 'pip install flatbuffers "mcap<2,>=1.2"'


def test_every_hint_names_an_extra_that_there_is() -> None:
    extras = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    named = set()
    for path in sorted((REPO / "bufgym").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        named |= set(re.findall(r"""install\(['"](\w+)['"]\)""", text))
        # No package index knows bufgym: a hint that names it would not work.
        assert not re.search(r"""pip install ["']?bufgym""", text), path
    assert {"plot", "train", "fleet", "ros"} <= named <= set(extras)

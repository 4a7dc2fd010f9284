"""Evolution on a Ray or Dask cluster: the same agents as without, also where it goes on after a kill."""

from __future__ import annotations

import csv
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.numpy import load_file

for extra in ("sb3_contrib", "tqdm", "tensorboard", "cma", "joblib"):
    pytest.importorskip(extra, reason="the extra [train] is not installed")

from agents import training  # noqa: E402  (these need the extra)
from agents.runs import MODEL, prepare  # noqa: E402
from agents.settings import Settings  # noqa: E402
from bufgym.benchmark import cluster  # noqa: E402
from bufgym.errors import BufgymError  # noqa: E402

REPO = Path(__file__).resolve().parent.parent
LIBRARY = {"dask": "distributed", "ray": "ray"}
FEW = {"suite": "interruption-v1", "capacities": "4", "algo": "evolution", "validate_every": 19_000}
FEW |= {"validation_episodes": 6, "test_seeds": 2, "seeds": 2}


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def trained(name: str, steps: int, *more: str) -> None:
    """A command of its own, as cluster libraries begin processes and threads that outlive a test."""
    options = [(f"--{key.replace('_', '-')}", str(value)) for key, value in FEW.items()]
    words = [word for pair in options for word in pair]
    command = [sys.executable, str(REPO / "train.py"), *words, "--name", name, "--steps", str(steps), *more]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def fitness(folder: Path, seed: int) -> list[tuple[str, str]]:
    """(steps, fitness) of every generation, as written."""
    with (folder / f"seed-{seed}" / "curve.csv").open(newline="", encoding="utf-8") as file:
        return [(row["steps"], row["fitness"]) for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run's folder without a cluster."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(tmp_path_factory.mktemp("local"))
        trained("local", 38_000)
        return Path("runs/local").resolve()


@pytest.mark.nightly
@pytest.mark.parametrize("backend", ["dask", "ray"])
def test_a_cluster_gives_the_same_agents_bit_for_bit(backend: str, request: pytest.FixtureRequest) -> None:
    """Two seeds; on the cluster half of the steps, and then the rest."""
    if importlib.util.find_spec(LIBRARY[backend]) is None:
        pytest.skip(f"{LIBRARY[backend]} is not installed")
    local: Path = request.getfixturevalue("local")  # only where there is something to compare
    trained("cluster", 19_000, "--backend", backend)
    trained("cluster", 38_000, "--backend", backend, "--resume")
    assert fitness(local, 0) != fitness(local, 1)
    cluster = Path("runs/cluster")
    for seed in (0, 1):
        assert fitness(cluster, seed) == fitness(local, seed) and len(fitness(local, seed)) > 1
        one, other = (load_file(folder / f"seed-{seed}" / MODEL) for folder in (local, cluster))
        assert one.keys() == other.keys()
        assert all(one[key].tobytes() == other[key].tobytes() for key in one)


@pytest.mark.parametrize("backend", ["dask", "ray"])
def test_a_missing_library_is_one_clear_error(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, LIBRARY[backend], None)
    with pytest.raises(BufgymError, match=f"{LIBRARY[backend]} is missing: "), cluster.begun(backend, None):
        pass


def test_resuming_may_change_the_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    """The settings of a run leave out where it was computed, as the result is the same."""
    local = Settings(name="run", **{**FEW, "seeds": 1})  # type: ignore[arg-type]
    prepare(local)
    dask = Settings(name="run", backend="dask", address="tcp://host:1", resume=True, **FEW)  # type: ignore[arg-type]
    folder = prepare(dask)
    assert dask.command == Settings(**FEW).command  # type: ignore[arg-type]

    def refuse(backend: str, address: str | None) -> None:
        raise BufgymError(f"{backend} at {address}")

    monkeypatch.setattr(cluster, "_client", refuse)
    monkeypatch.setattr(training, "ValidationSets", lambda *args, **options: None)
    with pytest.raises(BufgymError, match="dask at tcp://host:1"):
        training.train_all(dask, folder)

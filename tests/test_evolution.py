"""Evolved agents: where they begin, what they leave, and that a run that goes on repeats on a cluster."""

import csv
import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_cases import Patch
from needs import needs
from safetensors.numpy import load_file

from agents import cluster
from agents.families import Family, Run, run_of
from agents.mixed_env import Cell
from agents.objectives import suites
from agents.runs import MODEL
from agents.settings import Cluster, Evolve
from agents.tasks import Suites
from bufgym import policies
from bufgym.oracle import EveryLength, integer, law
from bufgym.policies import guided, weights
from bufgym.scenario import Interruption, Uplink
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from studies import families, joint

ON = Suites(("interruption-v1",), capacities=(4,), test_seeds=25)
TINY = Evolve(suites=ON, name="tiny", steps=60_000, validate_every=20_000, validation_episodes=30)
SHORT = Cell("short", Interruption(t_max=40), 5)


@pytest.mark.parametrize("name", ["afr", "min-gap", "drop-oldest", "drop-newest", "linear-alpha"])
def test_one_run_through_the_longest_interruption_is_a_run_through_each(name: str) -> None:
    scenario, policy = SHORT.scenario, policies.get(name)
    assert isinstance(scenario, Interruption)
    lengths = EveryLength(scenario, [5])
    qoi = [outcome(run(policy, [scenario.episode(T)], 5, scenario.value), 0).qoi for T in range(1, 41)]
    np.testing.assert_allclose(lengths.qoi(policy)[0, 1:], qoi, rtol=1e-12)
    best = [1 + integer(5, T, scenario.value) for T in range(1, 41)]
    share = law(scenario)[1:]
    assert lengths.regrets(policy)[0] == pytest.approx(1 - share @ qoi / (share @ best), abs=1e-12)


def test_a_candidate_is_measured_by_what_is_left_of_afrs_regret(tmp_path: Path, monkeypatch: Patch) -> None:
    """Each suite counts alike, whatever its runs; parts are taken in turn, and hold other runs."""
    monkeypatch.setattr(suites, "PARTS", 2)
    monkeypatch.setattr(suites, "RUNS", 5)
    few = {"lte-v1": 8, "sustained-v1": 12}
    found = {name: runs_of(2e6 * (k + 1)) for k, name in enumerate(few)}
    monkeypatch.setattr(suites, "of_suite", lambda name, *rest, **options: {"all": found[name][: few[name]]})
    task = suites.SuitesObjective(replace(TINY, suites=Suites(tuple(few), capacities=(4,))), tmp_path, 3)
    afr, rule = policies.get("afr"), policies.get("min-gap")
    assert task.fitness(afr, 0) == task.fitness(afr, 1) == 1
    one, other = task.training
    assert task.fitness(rule, 3) == np.mean([family.share(rule) for family in other]) != task.fitness(rule, 0)
    assert task.decisions(2) == sum(family.decisions for family in one)


def test_where_afr_loses_nothing_nothing_can_be_learned(tmp_path: Path, monkeypatch: Patch) -> None:
    ample = runs_of(9e7)
    monkeypatch.setattr(suites, "of_suite", lambda *rest, **options: {"all": ample})
    with pytest.raises(BufgymError, match="suite interruption-v1: AFR loses nothing there"):
        _ = suites.SuitesObjective(TINY, tmp_path, 3).training


def runs_of(bytes_per_s: float) -> list[Run]:
    link = Trace.steps([(1.0, bytes_per_s), (1.0, bytes_per_s / 4)], name="link")
    return [run_of(str(seed), Uplink(traces=(link,), duration_s=4.0), seed, 5) for seed in range(12)]


REPO = Path(__file__).resolve().parent.parent
LIBRARY = {"dask": "distributed", "ray": "ray"}
FEW = {"suite": "interruption-v1", "capacities": "4", "validate_every": 19_000}
FEW |= {"validation_episodes": 6, "test_seeds": 2, "seeds": 2}


def trained(name: str, steps: int, *more: str) -> None:
    """A command of its own, as cluster libraries begin processes and threads that outlive a test."""
    options = [(f"--{key.replace('_', '-')}", str(value)) for key, value in FEW.items()]
    words = [word for pair in options for word in pair]
    command = [sys.executable, str(REPO / "train.py"), *words, "--name", name, "--steps", str(steps), *more]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def fitness(folder: Path, seed: int) -> list[tuple[str, str]]:
    with (folder / f"seed-{seed}" / "curve.csv").open(newline="", encoding="utf-8") as file:
        return [(row["steps"], row["fitness"]) for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(tmp_path_factory.mktemp("local"))
        trained("local", 38_000)
        return Path("runs/local").resolve()


@pytest.mark.nightly
@pytest.mark.parametrize("backend", ["dask", "ray"])
@pytest.mark.timeout(900)  # three trainings, two of them on a cluster that begins
def test_a_cluster_gives_the_same_agents_bit_for_bit(backend: str, request: pytest.FixtureRequest) -> None:
    """Two seeds; on the cluster half of the steps, and then the rest."""
    if importlib.util.find_spec(LIBRARY[backend]) is None:
        pytest.skip(needs("ray" if backend == "ray" else "extras", LIBRARY[backend]))
    local: Path = request.getfixturevalue("local")  # only where there is something to compare
    trained("cluster", 19_000, "--backend", backend)
    trained("cluster", 38_000, "--backend", backend, "--resume")
    cluster = Path("runs/cluster")
    for seed in (0, 1):
        assert fitness(cluster, seed) == fitness(local, seed) and len(fitness(local, seed)) > 1
        one, other = (load_file(folder / f"seed-{seed}" / MODEL) for folder in (local, cluster))
        assert one.keys() == other.keys()
        assert all(one[key].tobytes() == other[key].tobytes() for key in one)


@pytest.mark.parametrize("backend", ["dask", "ray"])
def test_a_missing_library_is_one_clear_error(backend: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, LIBRARY[backend], None)
    with pytest.raises(BufgymError, match=f"needs {LIBRARY[backend]}: "), cluster.running(Cluster(backend)):
        pass


# One agent for all links: its families, the fitness of a candidate, and the search from end to end, tiny.


def runs() -> list[families.Run]:
    """Two links that carry a third of 30 messages a second."""
    return [
        run_of(link.name, Uplink(traces=(link,), duration_s=6.0), seed, L, max_bytes)
        for link in (Trace.steps([(1.0, 4e6), (1.0, 5e5)], name="a"), Trace.steps([(2.0, 3e6), (1.0, 1e6)], name="b"))
        for seed in range(2)
        for L, max_bytes in ((4, None), (8, 8 * 230_000))
    ]


def test_shares_are_sums_over_the_links_drawn() -> None:
    family, rule = Family("small", runs()), policies.get("gap-price")
    afr, h = policies.get("afr"), family.play(rule)
    assert family.share(afr) == 1 and family.decisions == 8 * 180
    assert family.share(rule) == pytest.approx((family.best - h).sum() / (family.best - family.afr).sum())
    only_b = family.shares(h, np.array([[0.0, 1.0]]))  # the last four runs
    assert only_b == pytest.approx((family.best - h)[4:].sum() / (family.best - family.afr)[4:].sum())
    (_, (alike, above)), (one, (below, _)) = family.against([rule, afr])
    assert alike == (0, 0, 0) and one == 1
    assert (above.value, above.low, above.high) == pytest.approx((-below.value, -below.high, -below.low))
    ratios = (1 - h / family.best + 0.01) / (1 - family.afr / family.best + 0.01)
    assert Family("random", runs()).share(rule) == pytest.approx(ratios.mean())


def test_the_search_begins_at_the_rule_and_leaves_a_file(tmp_path: Path, monkeypatch: Patch) -> None:
    few = runs()
    monkeypatch.setattr(joint, "families", lambda split, folder, data=None: {"task": few, "default-frames": few})
    monkeypatch.setattr(joint, "RUNS", {"task": 4, "default-frames": 4})
    monkeypatch.setattr(joint, "POPULATION", 4)
    family = Family("task", few)
    assert family.share(joint.agent(np.zeros(320)).policy("plain")) == family.share(policies.get("gap-price"))
    file = tmp_path / "agent.safetensors"
    joint.main(seed=3, generations=2, out=file)
    found, notes = weights.read(file)
    assert isinstance(found, guided.GuidedWeights) and 0 < np.abs(found.weight).max() < 1
    assert notes["training"] == "python -m studies.joint --seed 3 --generations 2"
    joint.main(file, out=tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text().splitlines()
    own, rule = (family.share(each) for each in (policies.load(file), policies.get("gap-price")))
    assert next(row for row in page if row.startswith("| task |")).split(" | ")[3:] == [f"{rule:.3f}", f"{own:.3f} |"]
    frames = [row.split(" |")[0] for row in page if row.startswith("| default")]
    assert frames == [f"| default-frames, L = {L}" for L in (4, 8)] * 2


def test_every_family_is_drawn_anew_for_each_split(tmp_path: Path, monkeypatch: Patch) -> None:
    names = ("of_suite", "task", "default_frames", "random_streams")
    monkeypatch.setattr(families, "merged", lambda found, chosen=bool: [found])
    for name in names:
        monkeypatch.setattr(families, name, lambda split="", *rest, **options: {"split": split})
    assert list(families.families("train", tmp_path)) == list(joint.RUNS)
    assert len(list(tmp_path.glob("train-*.pkl"))) == len(joint.RUNS)


def test_random_streams_are_the_same_for_a_seed() -> None:
    one, again = (families.random_streams("validation", 3) for _ in range(2))
    assert [run["best"] for run in one] == [run["best"] for run in again]
    assert len({run["capacity"] for run in families.random_streams("train", 6)}) > 1

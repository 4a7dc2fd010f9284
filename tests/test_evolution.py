"""Evolved agents: where they begin, what they leave, that a killed run goes on and repeats, also on a cluster."""

import csv
import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file
from train_cases import columns, in_a_folder_of_its_own  # noqa: F401

from agents import cluster, training
from agents.cma_es import Evolution
from agents.mixed_env import Cell, cells
from agents.objectives import queue
from agents.objectives.objective import to_vector, with_vector
from agents.runs import MODEL, prepare
from agents.settings import LINK, MOTION, SEES, Settings
from bufgym import policies
from bufgym.ground.errors import BufgymError
from bufgym.model.qoi import exponential
from bufgym.oracle import EveryLength, integer, law
from bufgym.policies import learned, weights
from bufgym.scenario import Interruption, Streams, Uplink
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace

TINY = Settings(
    **{"suite": "interruption-v1", "capacities": "4", "algo": "evolution", "name": "tiny", "steps": 60_000},
    **{"validate_every": 20_000, "validation_episodes": 30, "test_seeds": 25},
)


@pytest.mark.parametrize(("sees", "like"), [("motion", "min-motion-gap"), ("time", "min-gap")])
def test_it_begins_with_the_smallest_merged_gap(sees: str, like: str) -> None:
    """Without its leaning towards the new, the regret of the first weights is that of the policy they stand for."""
    weights = queue.start(SEES[sees], 3, np.random.default_rng(0))
    weights.drop.skip[weights.fields.index("rank")] = 0.0
    lengths = EveryLength(SHORT.scenario, [5])
    assert lengths.regrets(learned.policy("first", weights)) == lengths.regrets(policies.get(like))


def agent(seed: int = 1) -> weights.Weights:
    rng = np.random.default_rng(seed)
    return queue.start(MOTION, 3, rng)


def test_an_agent_that_reads_more_decides_the_same_at_first() -> None:
    """New inputs are zeros in every layer and in the mixing."""
    old = with_vector(agent(), np.random.default_rng(2).normal(size=len(to_vector(agent()))))
    new = queue.reading(old, LINK)
    assert new.fields == LINK
    assert new.mix is not None and new.mix.shape == (len(new.context), len(new.slot)) == (10, 5)
    slow = Trace.steps([(1.0, 3_000_000), (2.0, 250_000), (7.0, 2_357_000)])
    episode = Uplink(traces=(slow,), duration_s=20).draw(Streams.seeded(3))
    before, after = (run(learned.policy("mine", one), [episode], 8, exponential(0.9)).batch.log for one in (old, new))
    assert (before == after).all()


def test_it_goes_on_from_a_file(tmp_path: Path) -> None:
    """The agent of the file begins the search, with more fields."""
    file = weights.save(tmp_path / "old.safetensors", agent(), {"name": "old"})
    settings = replace(TINY, suite="lte-v1", start=str(file), sees="link", steps=1, name="on", test_seeds=1).checked()
    begun = queue.QueueObjective(settings, tmp_path, 0).start()
    assert begun.fields == LINK and len(to_vector(begun)) > len(to_vector(agent()))
    moved = Evolution.around(begun, 0.3, 0).weights(to_vector(begun) + 1)
    assert (moved.drop.flat() != begun.drop.flat()).any()
    for broken in ({"algo": "ppo"}, {"suite": "topics-v1"}):
        with pytest.raises(BufgymError, match=r"start = .*: evolution of one queue's suites"):
            replace(settings, **{"algo": "evolution", **broken}).checked()


def test_weights_are_a_vector_and_back() -> None:
    """Searched are all numbers but those that every drop shares, and the acceptance's hidden layer."""
    weights = queue.start(MOTION, 3, np.random.default_rng(0))
    assert (weights.slot, weights.context) == (MOTION[:5], MOTION[5:])
    vector = to_vector(weights)
    assert len(vector) == 5 + (10 * 3 + 3 + 3) + (10 + 1) + 5 * 5
    again = with_vector(weights, vector)
    assert (to_vector(again) == vector).all()
    assert (again.parameters() == weights.parameters()).all()
    changed = with_vector(weights, np.arange(len(vector), dtype=float))
    assert changed.drop.skip.tolist() == [0, 1, 2, 3, 4, *[0] * 5]  # 0: what the context adds to every drop
    assert changed.mix is not None and changed.mix[-1, -1] == len(vector) - 1
    assert (changed.accept.layers[0][0] == weights.accept.layers[0][0]).all()


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


def test_sampled_episodes_take_traces_in_turn_and_stay_the_same() -> None:
    given = cells("sustained-v1", "train", (5, 10))
    sampled = queue.sampled_regrets(given[:4], seed=3, episodes=8)
    assert sampled.cells == given[:4]
    assert [len(drawn) for drawn in sampled.episodes] == [2] * 4
    traces = [episode.link.trace.name for drawn in sampled.episodes for episode in drawn]
    assert len(set(traces)) == 8
    afr = policies.get("afr")
    assert (sampled.regrets(afr) == sampled.regrets(afr)).all()
    assert len(queue.sampled_regrets(given, seed=3, episodes=3).cells) == 3  # fewer episodes than cells


def test_a_suite_is_measured_by_the_better_of_afr_and_drop_oldest() -> None:
    """As good as the better one in every cell is 1; exact cells each count, the worst most."""
    exact = queue.ExactRegrets([SHORT, SHORT._replace(capacity=9)])
    suite = queue.SuiteObjective(exact)
    afr, min_gap = policies.get("afr"), policies.get("min-gap")
    assert suite.over_rivals(afr) == pytest.approx(1.0)
    ratios = exact.regrets(min_gap) / exact.regrets(afr)
    assert suite.over_rivals(min_gap) == pytest.approx(np.sqrt(np.mean(np.square(ratios))))
    assert suite.over_rivals(policies.get("drop-newest")) == queue.WORST
    assert suite.decisions_of() == suite.decisions == 2 * 42


def test_a_part_is_measured_by_what_the_rivals_reach_on_all_parts() -> None:
    """Two parts with one cell each, of the same L and V: each part's regret over the mean of both rivals'."""
    cell = cells("sustained-v1", "train", (10,))[1]
    parts = [queue.sampled_regrets([cell], seed, episodes=1) for seed in (1, 2)]
    suite, policy = queue.SuiteObjective(*parts), policies.get("min-gap")
    regrets = [part.regrets(policy)[0] for part in parts]
    assert regrets[0] != regrets[1]
    rival = suite.rivals.mean()
    assert suite.over_rivals(policy, 0) == pytest.approx(regrets[0] / rival)
    assert suite.over_rivals(policy, 3) == pytest.approx(regrets[1] / rival)  # parts are taken in turn
    assert suite.over_rivals(policy) == pytest.approx(np.mean(regrets) / rival)
    assert suite.decisions_of() == suite.decisions_of(0) + suite.decisions_of(1)


@pytest.mark.nightly
def test_a_run_goes_on_after_a_kill_and_repeats() -> None:
    """What it leaves behind, test_train.py shows for every algorithm."""
    few = replace(TINY, steps=38_000, validate_every=19_000, validation_episodes=6, test_seeds=2)
    folder = prepare(few)
    training.train_all(few, folder)
    whole, notes = weights.read(folder / "seed-0" / MODEL)
    assert (notes["algo"], notes["suite"]) == ("evolution", "interruption-v1")
    rows = columns(folder / "seed-0" / "validation.csv", "steps", "regret")
    assert rows[0][0] == 0 and rows[-1][0] >= few.steps and all(0 <= regret < 1 for _, regret in rows)
    # Half of the steps, then the rest: the same agent to the last bit.
    half = replace(few, name="half", steps=few.steps // 2)
    folder = prepare(half)
    training.train_all(half, folder)
    rest = replace(half, steps=few.steps, resume=True)
    training.train_all(rest, prepare(rest))
    again, _ = weights.read(folder / "seed-0" / MODEL)
    assert (again.parameters() == whole.parameters()).all()


REPO = Path(__file__).resolve().parent.parent
LIBRARY = {"dask": "distributed", "ray": "ray"}
FEW = {"suite": "interruption-v1", "capacities": "4", "algo": "evolution", "validate_every": 19_000}
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

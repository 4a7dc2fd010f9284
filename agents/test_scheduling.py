"""Learned schedulers: a vector and back, fitness by hand, a killed run goes on where it was, a run from end to end."""

import csv
import dataclasses
import pickle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli_cases import Capsys, Patch
from train_cases import KilledError, columns, in_a_folder_of_its_own  # noqa: F401

import train
from agents.cma_es import Evolution, Search
from agents.objectives import topics
from agents.runs import MODEL, prepare
from agents.settings import Evolve
from agents.tasks import Suites
from bufgym import policies
from bufgym.model import qoi
from bufgym.model.topics import Topic
from bufgym.policies import weights
from bufgym.policies.guided_topics import SchedulerWeights
from bufgym.scenario import Client, Stream, suites
from bufgym.scenario.suites import Setting
from bufgym.sim import run
from bufgym.sim.metrics import topic_outcomes
from bufgym.traces import Trace

ON = Suites(("topics-v1",), test_seeds=1)
ZERO = SchedulerWeights(np.zeros(SchedulerWeights.SHAPE, np.float32))
TINY = Evolve(suites=ON, name="tiny", steps=4_000, validate_every=1_500)


def client(**more: Any) -> Client:
    """Two topics of which half can cross; every second the link stands still for one."""
    link = Trace.steps([(1.0, 20_000), (1.0, 0)])
    first, second = Topic("first", priority=5, weight=2), Topic("second", weight=1)
    streams = (Stream(first, 10, 500), Stream(second, 10, 1_500), Stream(Topic("command", no_drop=True), 2, 100))
    given: dict[str, Any] = {"duration_s": 4.0, "value": qoi.exponential(0.5)}
    return Client(streams, (link,), **(given | more))


def test_weights_are_a_vector_and_back() -> None:
    search = Search.around(ZERO, 0.1, 0)
    vector = np.arange(len(search.average), dtype=float)
    found = search.weights(vector)
    assert isinstance(found, SchedulerWeights) and (found.weight.reshape(-1) == vector).all()


def by_metrics(policy: policies.Policy, of: topics.ClientEpisodes) -> tuple[float, float, float, int]:
    """What ``reached`` says, from the statistics of ordinary runs."""
    topics = of.client.topics
    senders = run(policy, of.episodes, 6, of.client.value, topics=topics)
    qoi_, first, others, lost = 0.0, 0.0, 0.0, 0
    for i, episode in enumerate(of.episodes):
        for k, (topic, made) in enumerate(zip(topics, topic_outcomes(senders, i), strict=True)):
            times = episode.arrivals["arrival_us"]
            area = made.mean_age_s * (times[-1] - times[episode.arrivals["topic"] == k][0]) / 1e6
            qoi_ += topic.share * made.qoi
            first, others = first + area * (k == 0), others + area * (k > 0)
            lost += made.lost * topic.no_drop
    return qoi_, first, others, lost


def test_reached_is_what_the_metrics_say() -> None:
    for policy in (policies.get("fifo"), ZERO.policy("plain")):
        of = topics.ClientEpisodes(client(), 6, 2, np.random.default_rng(1))
        assert of.reached(policy) == pytest.approx(by_metrics(policy, of), rel=1e-9)
        assert of.reached(policy) == of.reached(policy)
    assert of.decisions == sum(len(episode.arrivals) for episode in of.episodes)


@pytest.mark.parametrize(
    ("reached", "expected"),
    [
        # Half the QoI, where 1.2 times the rival's is the best rule's; ages as they may be.
        ((50.0, 18.0, 30.0, 0), -0.5 + 3 * (1.02 * 1.2 - 0.5)),
        ((150.0, 10.0, 10.0, 0), -1.5),  # less age than asked for pays nothing
        ((150.0, 24.0, 30.0, 0), -1.5 + 4 * 0.3),  # 1.2 - 0.9
        ((150.0, 18.0, 70.0, 0), -1.5 + 0.25 * 0.5),  # 3.5 - 3
        ((150.0, 18.0, 30.0, 3), -1.5 + 3.0),  # three no_drop messages
        ((0.0, 40.0, 80.0, 1), 1 + 4 * 1.1 + 0.25 + 3 * 1.02 * 1.2),
    ],
)
def test_fitness_by_hand(reached: tuple[float, float, float, int], expected: float) -> None:
    result = topics.Reached(*reached)
    of: Any = SimpleNamespace(rival=topics.Reached(100.0, 20.0, 20.0, 0), best_qoi=120.0, reached=lambda policy: result)
    best = topics.Reached(2.0, 0.0, 1.0, 0)
    free: Any = SimpleNamespace(rival=topics.Reached(1.0, 1.0, 1.0, 0), best_qoi=1.0, reached=lambda policy: best)
    policy = policies.get("fifo")
    assert topics.mean_fitness(policy, [of]) == pytest.approx(expected)
    assert topics.mean_fitness(policy, [of, free]) == pytest.approx((expected - 2) / 2)


@pytest.fixture
def short_episodes(monkeypatch: Patch) -> None:
    def client_episodes(
        chosen: Suites, split: str, seed: int, episodes: int, episode_s: float | None = None, *, scale: float = 1.0
    ) -> Any:
        return [topics.ClientEpisodes(client(duration_s=2.0), 6, 1, np.random.default_rng([seed, split == "train"]))]

    monkeypatch.setattr(topics, "client_episodes", client_episodes)


@pytest.mark.parametrize("after", [pytest.param(after, marks=pytest.mark.nightly) for after in (5, 50, 60)] + [20])
def test_a_killed_run_goes_on_as_if_nothing_had_been(after: int, short_episodes: None, monkeypatch: Patch) -> None:
    """Killed after so many fitnesses: in the first generation, and in later ones."""
    whole, killed = Path("whole"), Path("killed")
    whole.mkdir(), killed.mkdir()
    best = Evolution(TINY).train_seed(whole, 2).reached
    true_fitness, left = topics.mean_fitness, [after]

    def fitness(policy: policies.Policy, episodes: Any) -> float:
        left[0] -= 1
        if left[0] < 0:
            raise KilledError
        return true_fitness(policy, episodes)

    monkeypatch.setattr(topics, "mean_fitness", fitness)
    with pytest.raises(KilledError):
        Evolution(TINY).train_seed(killed, 2)
    monkeypatch.setattr(topics, "mean_fitness", true_fitness)
    assert Evolution(TINY).train_seed(killed, 2).reached == best
    one, other = (folder / "seed-2" / MODEL for folder in (whole, killed))
    assert one.read_bytes() == other.read_bytes()
    ends = [pickle.loads((folder / "seed-2" / "evolution.pkl").read_bytes()) for folder in (whole, killed)]
    assert (ends[0].average == ends[1].average).all() and ends[0].steps == ends[1].steps >= TINY.steps
    # A validation that was not yet in a checkpoint is made, and written down, once more.
    tables = [columns(folder / "seed-2" / "validation.csv", "steps", "fitness") for folder in (whole, killed)]
    assert list(dict.fromkeys(tables[1])) == tables[0]


@pytest.mark.nightly
def test_a_run_leaves_an_agent_and_a_table(short_episodes: None, monkeypatch: Patch, capsys: Capsys) -> None:
    """Through ``train.main``; the test split as few seconds of one setting on one link."""
    suite = suites.get("topics-v1")

    def short(split: str, data: Path | None) -> dict[str, Setting]:
        label, setting = next(iter(suite.settings(split, data).items()))
        client = dataclasses.replace(setting.scenario, duration_s=3.0, traces=setting.scenario.traces[:1])
        return {label: dataclasses.replace(setting, scenario=client)} if split == "test" else suite.build(split, data)

    monkeypatch.setitem(suites.SUITES, suite.name, dataclasses.replace(suite, build=short))
    train.main(dataclasses.replace(TINY, steps=1_000))
    home = Path("runs/tiny")
    printed = capsys.readouterr().out
    assert "agent (seed 0)" in printed and "robofleet" in printed and "best on validation: seed 0" in printed
    assert (home / "model.safetensors").read_bytes() == (home / "seed-0" / "model.safetensors").read_bytes()
    made, noted = weights.read(home / "model.safetensors")
    assert isinstance(made, SchedulerWeights)
    assert (noted["suite"], noted["algo"], noted["seeds"]) == (suite.name, "evolve", [0])
    with (home / "rows.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["policy"] for row in rows} >= {"agent (seed 0)", "robofleet", "fifo"}
    assert (home / "results.txt").read_text(encoding="utf-8").strip() in printed
    assert prepare(dataclasses.replace(TINY, resume=True)).name == "tiny"

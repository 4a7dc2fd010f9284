"""Learned schedulers: a vector and back, fitness by hand, a killed run goes on where it was, a run from end to end."""

from __future__ import annotations

import csv
import dataclasses
import pickle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

for extra in ("sb3_contrib", "tqdm", "tensorboard", "cma"):
    pytest.importorskip(extra, reason="the extra [train] is not installed")

import train  # noqa: E402  (these need the extra)
from agents import scheduling, training  # noqa: E402
from bufgym import policies  # noqa: E402
from bufgym.errors import BufgymError  # noqa: E402
from bufgym.model import qoi  # noqa: E402
from bufgym.model.topics import Topic  # noqa: E402
from bufgym.policies import learned_topics, weights  # noqa: E402
from bufgym.scenario import (  # noqa: E402
    Client,
    Stream,
    suites,
)
from bufgym.sim import run  # noqa: E402
from bufgym.sim.metrics import topic_outcomes  # noqa: E402
from bufgym.traces import Trace  # noqa: E402

TINY = train.Arguments(
    suite="topics-v1", algo="evolution", name="tiny", steps=4_000, validate_every=1_500, test_seeds=1
)


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def client(**more: Any) -> Client:
    """Two topics of which half can cross; every second the link stands still for one."""
    link = Trace.steps([(1.0, 20_000), (1.0, 0)])
    streams = (
        Stream(Topic("first", priority=5, weight=2), 10, 500),
        Stream(Topic("second", weight=1), 10, 1_500),
        Stream(Topic("command", no_drop=True), 2, 100),
    )
    given: dict[str, Any] = {"duration_s": 4.0, "value": qoi.exponential(0.5)}
    return Client(streams, (link,), **(given | more))


def ground(count: int = 2, **more: Any) -> scheduling.Ground:
    return scheduling.Ground(client(**more), 6, count, np.random.default_rng(1))


# --- weights as a vector ---------------------------------------------------------------------------------------------


def test_weights_are_a_vector_and_back() -> None:
    c, n = len(scheduling.CONTEXT), len(scheduling.FIELDS)
    begin = scheduling.start()
    vector = scheduling.to_vector(begin)
    assert len(vector) == (n - c) + n + 1 + (n - c)
    assert scheduling.from_vector(vector).parameters().tobytes() == begin.parameters().tobytes()
    counted = np.arange(len(vector), dtype=float)
    made = scheduling.from_vector(counted)
    assert (scheduling.to_vector(made) == counted).all()
    # What the context adds to every candidate alike decides nothing, and stays 0.
    assert made.drop.skip.tolist() == [0] * c + list(range(n - c))
    assert made.send.skip.tolist() == [0] * c + list(range(len(vector) - n + c, len(vector)))
    assert made.accept.bias.tolist() == [2 * n - c]


def test_it_begins_greedy() -> None:
    """It reads fields that there are, sends what is no_drop first, and accepts with room."""
    assert set(scheduling.FIELDS) <= set(learned_topics.NAMES)
    (episode, *_) = ground().episodes
    given = client()
    senders = run(
        scheduling.policy_of(scheduling.to_vector(scheduling.start())), [episode], 6, given.value, topics=given.topics
    )
    batch = senders.batch
    assert batch.senders["invalid"][0] == 0
    assert topic_outcomes(senders, 0)[2].lost == 0
    assert batch.senders["rejected"][0] + batch.senders["evicted"][0] > 5


# --- grounds ---------------------------------------------------------------------------------------------------------


def by_metrics(policy: policies.Policy, of: scheduling.Ground) -> tuple[float, float, float, int]:
    """What ``reached`` says, from the statistics of ordinary runs."""
    topics = of.client.topics
    senders = run(policy, of.episodes, 6, of.client.value, topics=topics)
    qoi_, first, others, lost = 0.0, 0.0, 0.0, 0
    for i, episode in enumerate(of.episodes):
        for k, (topic, made) in enumerate(zip(topics, topic_outcomes(senders, i), strict=True)):
            times = episode.arrivals["arrival_us"]
            begin_us = times[episode.arrivals["topic"] == k][0]
            area = made.mean_age_s * (times[-1] - begin_us) / 1e6
            qoi_ += topic.share * made.qoi
            first, others = first + area * (k == 0), others + area * (k > 0)
            lost += made.lost * topic.no_drop
    return qoi_, first, others, lost


@pytest.mark.slow
def test_reached_is_what_the_metrics_say() -> None:
    for policy in (policies.get("fifo"), scheduling.policy_of(scheduling.to_vector(scheduling.start()))):
        of = ground()
        assert of.reached(policy) == pytest.approx(by_metrics(policy, of), rel=1e-9)
        assert of.reached(policy) == of.reached(policy)
    assert of.decisions == sum(len(episode.arrivals) for episode in of.episodes)


@pytest.mark.slow
def test_fitness_of_the_rival_itself() -> None:
    """As much QoI as itself: -1; 1 - 0.9 of age too much, three times: 0.3; no age is 1.5 times its own."""
    of = ground()
    of.rival = of.reached(policies.get(scheduling.RIVAL))
    lost = of.rival[3]
    assert scheduling.fitness(policies.get(scheduling.RIVAL), [of]) == pytest.approx(-1 + 3 * (1 - 0.9) + lost)
    twice = scheduling.fitness(policies.get(scheduling.RIVAL), [of, of])
    assert twice == pytest.approx(-1 + 3 * (1 - 0.9) + lost)


@pytest.mark.parametrize(
    ("reached", "expected"),
    [
        ((50.0, 18.0, 30.0, 0), -0.5 + 3 * 0.5),  # half the QoI, and so much below the rival; ages as they may be
        ((150.0, 10.0, 10.0, 0), -1.5),  # less age than asked for pays nothing
        ((100.0, 24.0, 30.0, 0), -1 + 3 * 0.3),  # 1.2 - 0.9
        ((100.0, 18.0, 40.0, 0), -1 + 0.25 * 0.5),  # 2 - 1.5
        ((100.0, 18.0, 30.0, 3), -1 + 3.0),  # three no_drop messages
        ((0.0, 40.0, 60.0, 1), 1 + 3 * 1.1 + 0.25 * 1.5 + 3),
    ],
)
def test_fitness_by_hand(reached: tuple[float, float, float, int], expected: float) -> None:
    of: Any = SimpleNamespace(rival=(100.0, 20.0, 20.0, 0), reached=lambda policy: reached)
    free: Any = SimpleNamespace(rival=(1.0, 1.0, 1.0, 0), reached=lambda policy: (2.0, 0.0, 1.0, 0))
    policy = policies.get("fifo")
    assert scheduling.fitness(policy, [of]) == pytest.approx(expected)
    assert scheduling.fitness(policy, [of, free]) == pytest.approx((expected - 2) / 2)


@pytest.mark.slow
def test_grounds_of_a_suite_are_one_a_setting() -> None:
    made = scheduling.grounds("topics-v1", "train", seed=3, episodes=1, episode_s=2.0)
    suite = suites.get("topics-v1")
    assert len(made) == len(suite.settings("train")) * len(suite.capacities)
    assert all(each.episodes[0].arrivals["arrival_us"][-1] <= 2_000_000 for each in made)
    again = scheduling.grounds("topics-v1", "train", seed=3, episodes=1, episode_s=2.0)
    assert [each.rival for each in made] == [each.rival for each in again]
    other = scheduling.grounds("topics-v1", "train", seed=4, episodes=1, episode_s=2.0)
    assert [each.rival for each in made] != [each.rival for each in other]


# --- runs ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_grounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grounds of seconds instead of minutes."""

    def grounds(
        suite: str, split: str, seed: int, episodes: int, episode_s: float | None = None, *, scale: float = 1.0
    ) -> Any:
        rng = np.random.default_rng([seed, split == "train"])
        return [scheduling.Ground(client(duration_s=2.0), 6, 1, rng)]

    monkeypatch.setattr(scheduling, "grounds", grounds)


class KilledError(Exception):
    """What stops a run in the middle."""


def rows_of(home: Path) -> list[tuple[int, float]]:
    """(steps, fitness) of each validation."""
    with (home / "validation.csv").open(newline="", encoding="utf-8") as file:
        return [(int(row["steps"]), float(row["fitness"])) for row in csv.DictReader(file)]


@pytest.mark.slow
@pytest.mark.parametrize("after", [5, 20, 50, 60])
def test_a_killed_run_goes_on_as_if_nothing_had_been(
    after: int, small_grounds: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """KilledError after so many fitnesses: in the first generation, and in later ones."""
    whole, killed = Path("whole"), Path("killed")
    whole.mkdir(), killed.mkdir()
    best, _ = scheduling.train(TINY, whole, seed=2)
    true_fitness, left = scheduling.fitness, [after]

    def fitness(policy: policies.Policy, grounds: Any) -> float:
        left[0] -= 1
        if left[0] < 0:
            raise KilledError
        return true_fitness(policy, grounds)

    monkeypatch.setattr(scheduling, "fitness", fitness)
    with pytest.raises(KilledError):
        scheduling.train(TINY, killed, seed=2)
    monkeypatch.setattr(scheduling, "fitness", true_fitness)
    resumed, _ = scheduling.train(TINY, killed, seed=2)
    assert resumed == best
    one, other = (folder / "seed-2" / scheduling.MODEL for folder in (whole, killed))
    assert one.read_bytes() == other.read_bytes()
    ends = [pickle.loads((folder / "seed-2" / "evolution.pkl").read_bytes())[0] for folder in (whole, killed)]
    assert (ends[0].average == ends[1].average).all() and ends[0].steps == ends[1].steps >= TINY.steps
    # A validation that was not yet in a checkpoint is made, and written down, once more.
    assert list(dict.fromkeys(rows_of(killed / "seed-2"))) == rows_of(whole / "seed-2")


@pytest.mark.slow
def test_seeds_repeat_themselves_and_differ(small_grounds: None) -> None:
    few = dataclasses.replace(TINY, steps=1_500)
    agents = []
    for name, seed in (("a", 2), ("b", 2), ("c", 3)):
        Path(name).mkdir()
        scheduling.train(few, Path(name), seed)
        agents.append(pickle.loads(Path(name, f"seed-{seed}", "evolution.pkl").read_bytes())[0].average)
    assert (agents[0] == agents[1]).all()
    assert (agents[0] != agents[2]).any()


@pytest.mark.slow
def test_a_run_leaves_an_agent_and_a_table(
    small_grounds: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Through ``train.main``; the test split as few seconds of one setting."""
    suite = suites.get("topics-v1")
    true_parts = scheduling.suite_parts

    def short(suite: Any, split: str, seeds: int | None) -> Any:
        return true_parts(suite, split, seeds, duration_s=3.0)[:1]

    monkeypatch.setattr(scheduling, "suite_parts", short)
    train.main(dataclasses.replace(TINY, steps=1_000))
    home = Path("runs/tiny")
    told = capsys.readouterr().out
    assert "agent (seed 0)" in told and "robofleet" in told and "best on validation: seed 0" in told
    assert (home / "model.safetensors").read_bytes() == (home / "seed-0" / "model.safetensors").read_bytes()
    made, noted = weights.read_any(home / "model.safetensors")
    assert isinstance(made, learned_topics.TopicWeights) and made.fields == scheduling.FIELDS
    assert (noted["suite"], noted["algo"], noted["seeds"]) == (suite.name, "evolution", [0])
    with (home / "rows.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["policy"] for row in rows} >= {"agent (seed 0)", "robofleet", "fifo"}
    assert (home / "results.txt").read_text(encoding="utf-8").strip() in told
    assert training.prepare(dataclasses.replace(TINY, resume=True)).name == "tiny"


@pytest.mark.parametrize("wrong", [{"suite": "topics-v1,lte-v1"}, {"algo": "ppo"}])
def test_a_scheduler_learns_alone_and_by_evolution(wrong: dict[str, str]) -> None:
    with pytest.raises(BufgymError, match="topics-v1: a scheduler learns from one suite alone, by --algo evolution"):
        scheduling.wanted(dataclasses.replace(TINY, **wrong))
    assert scheduling.wanted(TINY)
    assert not scheduling.wanted(dataclasses.replace(TINY, suite="lte-v1"))


def test_a_varied_client_keeps_three_topics_at_least() -> None:
    """Some of its own, in their order, on links of another speed."""
    whole = client(duration_s=2.0)
    rng, seen = np.random.default_rng(1), set()
    for _ in range(30):
        made = scheduling.varied(whole, rng)
        assert len(made.streams) >= min(3, len(whole.streams))
        assert [stream for stream in whole.streams if stream in made.streams] == list(made.streams)
        assert scheduling.SCALES[0] <= made.scale <= scheduling.SCALES[1]
        seen.add(len(made.streams))
    assert len(seen) > 1 or len(whole.streams) <= 3


def test_a_suite_of_one_queue_has_no_grounds() -> None:
    with pytest.raises(BufgymError, match="suite interruption-v1: has no topics"):
        scheduling.grounds("interruption-v1", "train", 0, 1)

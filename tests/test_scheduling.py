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
from agents import cma_es  # noqa: E402
from agents.objectives import topics  # noqa: E402
from agents.objectives.objective import policy_of, to_vector, with_vector  # noqa: E402
from agents.runs import MODEL, prepare  # noqa: E402
from agents.settings import Settings  # noqa: E402
from bufgym import policies  # noqa: E402
from bufgym.errors import BufgymError  # noqa: E402
from bufgym.model import qoi  # noqa: E402
from bufgym.model.topics import Topic  # noqa: E402
from bufgym.policies import learned_topics, weights  # noqa: E402
from bufgym.scenario import Client, Stream, suites  # noqa: E402
from bufgym.scenario.suites import Setting  # noqa: E402
from bufgym.sim import run  # noqa: E402
from bufgym.sim.metrics import topic_outcomes  # noqa: E402
from bufgym.traces import Trace  # noqa: E402

TINY = Settings(suite="topics-v1", algo="evolution", name="tiny", steps=4_000, validate_every=1_500, test_seeds=1)


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


def episodes_of(count: int = 2, **more: Any) -> topics.ClientEpisodes:
    return topics.ClientEpisodes(client(**more), 6, count, np.random.default_rng(1))


# --- weights as a vector ---------------------------------------------------------------------------------------------


def test_weights_are_a_vector_and_back() -> None:
    c, n = len(topics.CONTEXT), len(topics.FIELDS)
    begin = topics.start()
    vector = to_vector(begin)
    assert len(vector) == (n - c) + n + 1 + (n - c)
    assert with_vector(begin, vector).parameters().tobytes() == begin.parameters().tobytes()
    counted = np.arange(len(vector), dtype=float)
    made = with_vector(begin, counted)
    assert (to_vector(made) == counted).all()
    # What the context adds to every candidate alike decides nothing, and stays 0.
    assert made.drop.skip.tolist() == [0] * c + list(range(n - c))
    assert made.send.skip.tolist() == [0] * c + list(range(len(vector) - n + c, len(vector)))
    assert made.accept.bias.tolist() == [2 * n - c]


def test_it_begins_greedy() -> None:
    """It reads fields that there are, sends what is no_drop first, and accepts with room."""
    assert set(topics.FIELDS) <= set(learned_topics.NAMES)
    (episode, *_) = episodes_of().episodes
    given = client()
    senders = run(policy_of("greedy", topics.start()), [episode], 6, given.value, topics=given.topics)
    batch = senders.batch
    assert batch.senders["invalid"][0] == 0
    assert topic_outcomes(senders, 0)[2].lost == 0
    assert batch.senders["rejected"][0] + batch.senders["evicted"][0] > 5


# --- episodes --------------------------------------------------------------------------------------------------------


def by_metrics(policy: policies.Policy, of: topics.ClientEpisodes) -> tuple[float, float, float, int]:
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
    for policy in (policies.get("fifo"), policy_of("greedy", topics.start())):
        of = episodes_of()
        assert of.reached(policy) == pytest.approx(by_metrics(policy, of), rel=1e-9)
        assert of.reached(policy) == of.reached(policy)
    assert of.decisions == sum(len(episode.arrivals) for episode in of.episodes)


@pytest.mark.slow
def test_fitness_of_the_rival_itself() -> None:
    """As much QoI as itself: -1; 1 - 0.9 of age too much, three times: 0.3; no age is 1.5 times its own."""
    of = episodes_of()
    of.rival = of.reached(policies.get(topics.RIVAL))
    lost = of.rival[3]
    assert topics.mean_fitness(policies.get(topics.RIVAL), [of]) == pytest.approx(-1 + 3 * (1 - 0.9) + lost)
    twice = topics.mean_fitness(policies.get(topics.RIVAL), [of, of])
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
    result = topics.Reached(*reached)
    of: Any = SimpleNamespace(rival=topics.Reached(100.0, 20.0, 20.0, 0), reached=lambda policy: result)
    best = topics.Reached(2.0, 0.0, 1.0, 0)
    free: Any = SimpleNamespace(rival=topics.Reached(1.0, 1.0, 1.0, 0), reached=lambda policy: best)
    policy = policies.get("fifo")
    assert topics.mean_fitness(policy, [of]) == pytest.approx(expected)
    assert topics.mean_fitness(policy, [of, free]) == pytest.approx((expected - 2) / 2)


@pytest.mark.slow
def test_a_suite_has_episodes_of_each_setting() -> None:
    made = topics.client_episodes("topics-v1", "train", seed=3, episodes=1, episode_s=2.0)
    suite = suites.get("topics-v1")
    assert len(made) == len(suite.settings("train")) * len(suite.capacities)
    assert all(each.episodes[0].arrivals["arrival_us"][-1] <= 2_000_000 for each in made)
    again = topics.client_episodes("topics-v1", "train", seed=3, episodes=1, episode_s=2.0)
    assert [each.rival for each in made] == [each.rival for each in again]
    other = topics.client_episodes("topics-v1", "train", seed=4, episodes=1, episode_s=2.0)
    assert [each.rival for each in made] != [each.rival for each in other]


# --- runs ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of seconds instead of minutes."""

    def client_episodes(
        suite: str, split: str, seed: int, episodes: int, episode_s: float | None = None, *, scale: float = 1.0
    ) -> Any:
        rng = np.random.default_rng([seed, split == "train"])
        return [topics.ClientEpisodes(client(duration_s=2.0), 6, 1, rng)]

    monkeypatch.setattr(topics, "client_episodes", client_episodes)


class KilledError(Exception):
    """What stops a run in the middle."""


def rows_of(home: Path) -> list[tuple[int, float]]:
    """(steps, fitness) of each validation."""
    with (home / "validation.csv").open(newline="", encoding="utf-8") as file:
        return [(int(row["steps"]), float(row["fitness"])) for row in csv.DictReader(file)]


@pytest.mark.slow
@pytest.mark.parametrize("after", [5, 20, 50, 60])
def test_a_killed_run_goes_on_as_if_nothing_had_been(
    after: int, short_episodes: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """KilledError after so many fitnesses: in the first generation, and in later ones."""
    whole, killed = Path("whole"), Path("killed")
    whole.mkdir(), killed.mkdir()
    best = cma_es.train(TINY, whole, seed=2).reached
    true_fitness, left = topics.mean_fitness, [after]

    def fitness(policy: policies.Policy, episodes: Any) -> float:
        left[0] -= 1
        if left[0] < 0:
            raise KilledError
        return true_fitness(policy, episodes)

    monkeypatch.setattr(topics, "mean_fitness", fitness)
    with pytest.raises(KilledError):
        cma_es.train(TINY, killed, seed=2)
    monkeypatch.setattr(topics, "mean_fitness", true_fitness)
    resumed = cma_es.train(TINY, killed, seed=2).reached
    assert resumed == best
    one, other = (folder / "seed-2" / MODEL for folder in (whole, killed))
    assert one.read_bytes() == other.read_bytes()
    ends = [pickle.loads((folder / "seed-2" / "evolution.pkl").read_bytes()) for folder in (whole, killed)]
    assert (ends[0].average == ends[1].average).all() and ends[0].steps == ends[1].steps >= TINY.steps
    # A validation that was not yet in a checkpoint is made, and written down, once more.
    assert list(dict.fromkeys(rows_of(killed / "seed-2"))) == rows_of(whole / "seed-2")


@pytest.mark.slow
def test_seeds_repeat_themselves_and_differ(short_episodes: None) -> None:
    few = dataclasses.replace(TINY, steps=1_500)
    agents = []
    for name, seed in (("a", 2), ("b", 2), ("c", 3)):
        Path(name).mkdir()
        cma_es.train(few, Path(name), seed)
        agents.append(pickle.loads(Path(name, f"seed-{seed}", "evolution.pkl").read_bytes()).average)
    assert (agents[0] == agents[1]).all()
    assert (agents[0] != agents[2]).any()


@pytest.mark.slow
def test_a_run_leaves_an_agent_and_a_table(
    short_episodes: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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
    made, noted = weights.read_any(home / "model.safetensors")
    assert isinstance(made, learned_topics.TopicWeights) and made.fields == topics.FIELDS
    assert (noted["suite"], noted["algo"], noted["seeds"]) == (suite.name, "evolution", [0])
    with (home / "rows.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["policy"] for row in rows} >= {"agent (seed 0)", "robofleet", "fifo"}
    assert (home / "results.txt").read_text(encoding="utf-8").strip() in printed
    assert prepare(dataclasses.replace(TINY, resume=True)).name == "tiny"


def test_a_varied_client_keeps_three_topics_at_least() -> None:
    """Some of its own, in their order, on links of another speed."""
    whole = client(duration_s=2.0)
    rng, seen = np.random.default_rng(1), set()
    for _ in range(30):
        made = topics.varied(whole, rng)
        assert len(made.streams) >= min(3, len(whole.streams))
        assert [stream for stream in whole.streams if stream in made.streams] == list(made.streams)
        assert topics.SCALES[0] <= made.scale <= topics.SCALES[1]
        seen.add(len(made.streams))
    assert len(seen) > 1 or len(whole.streams) <= 3


def test_a_suite_of_one_queue_has_no_clients() -> None:
    with pytest.raises(BufgymError, match="suite interruption-v1: has no topics"):
        topics.client_episodes("interruption-v1", "train", 0, 1)

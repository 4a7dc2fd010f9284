"""Tuned rules: what is searched, measures by hand, a killed search goes on where it was, and names that others take."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli_cases import Capsys, Patch
from refusal_cases import refuse
from train_cases import KilledError, columns, in_a_folder_of_its_own  # noqa: F401

import train
from agents import topics, tuning
from agents.settings import Tune
from agents.tasks import Place
from agents.tuning import Search, searched, tune
from agents.tuning_episodes import QueueEpisodes, Task
from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.model import qoi
from bufgym.model.topics import Topic
from bufgym.scenario import Client, Stream
from bufgym.sim import run
from bufgym.sim.metrics import topic_outcomes
from bufgym.traces import Trace

ON = Place(on="lte:duration_s=20", capacity=(3,))
TINY = Tune(
    rule="target-gap", parameters=("pace_s", "short"), place=ON, name="tiny", steps=200_000, validate_every=60_000
)


def client(**more: Any) -> Client:
    """Two topics of which half can cross; every second the link stands still for one."""
    link = Trace.steps([(1.0, 20_000), (1.0, 0)])
    first, second = Topic("first", priority=5, weight=2), Topic("second", weight=1)
    streams = (Stream(first, 10, 500), Stream(second, 10, 1_500), Stream(Topic("command", no_drop=True), 2, 100))
    given: dict[str, Any] = {"duration_s": 4.0, "value": qoi.exponential(0.5)}
    return Client(streams, (link,), **(given | more))


def test_candidates_are_the_rule_with_its_numbers_times_powers_of_e() -> None:
    rule = policies.get("target-gap")
    search = Search.around(rule, ["pace_s", "short"], 0)
    assert search.policy(np.zeros(2)) is rule
    found = search.policy(np.array([1.0, 0.0]))
    assert found.parameters["pace_s"] == float(f"{np.e * rule.parameters['pace_s']:.3g}")
    assert {**found.parameters, "pace_s": 0} == {**rule.parameters, "pace_s": 0}
    assert policies.get(found.name).parameters == found.parameters  # the name holds all of it
    again = Search.around(found, ["short"], 0).policy(np.array([1.0]))
    assert again.parameters["pace_s"] == found.parameters["pace_s"] and again.name.startswith("target-gap:")
    assert policies.get(again.name).parameters == again.parameters


def test_what_is_searched() -> None:
    rule = policies.get("gap-price")
    assert set(rule.parameters) == set(searched(rule, ()))
    refuse(r"unknown parameter 'kapa'", searched, rule, ["kapa"])
    still = dataclasses.replace(rule, parameters={**rule.parameters, "near": 0.0})
    refuse("policy gap-price: has no number above 0 among those asked for", searched, still, ["near"])
    refuse("policy afr: has no numbers", searched, policies.get("afr"), ())
    fifo = Tune(rule="target-gap", place=Place(on="topics-v1"))
    refuse("policy target-gap: is a drop rule of one queue, and topics-v1 has several topics", tune, fifo)


def test_options_that_a_place_has_no_use_for_are_refused() -> None:
    own = "suite lte-v1: has streams and links of its own, so no --workload and no --trace"
    refuse(own, Place, "lte-v1", workload="drive.csv")
    refuse(own, Place, "lte-v1", trace=("4Mbit/s",))
    nobodys = "--data is of a suite, which --on names"
    refuse(nobodys, Place, data="recordings")
    refuse(nobodys, Place, workload="drive.csv", data="recordings")
    refuse("--workload drive.csv takes the place of --on lte: must be one", Place, "lte", workload="drive.csv")
    assert (Place().on, Place(workload="drive.csv").on) == ("lte", "")
    assert Place("lte-belgium-v1", data="recordings").data == "recordings"


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
    for policy in (policies.get("fifo"), policies.get("gap-priority")):
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
def test_the_measure_of_topics_by_hand(reached: tuple[float, float, float, int], expected: float) -> None:
    result = topics.Reached(*reached)
    of: Any = SimpleNamespace(rival=topics.Reached(100.0, 20.0, 20.0, 0), best_qoi=120.0, reached=lambda policy: result)
    assert topics.ClientEpisodes.measure(of, policies.get("fifo")) == pytest.approx(expected)


def test_the_measure_of_a_queue_is_the_share_of_the_plain_rules_information() -> None:
    scenario, rule, other = scenarios.get("lte:duration_s=5"), policies.get("target-gap"), policies.get("drop-oldest")
    of = QueueEpisodes(scenario, 3, [1, 2], rule)
    assert of.measure(rule) == -1
    h = [run(policy, of.episodes, 3, scenario.value).batch.senders["delivered_gain"] + 1 for policy in (other, rule)]
    assert of.measure(other) == pytest.approx(-np.mean(h[0] / h[1]))


@pytest.mark.parametrize("after", [5, 40])
def test_a_killed_search_goes_on_as_if_nothing_had_been(after: int, monkeypatch: Patch) -> None:
    """Killed after so many measures: in the first generation, and in a later one."""
    whole, true_mean, left = tune(TINY), tuning.mean, [after]

    def mean(policy: policies.Policy, episodes: Any) -> float:
        left[0] -= 1
        if left[0] < 0:
            raise KilledError
        return true_mean(policy, episodes)

    monkeypatch.setattr(tuning, "mean", mean)
    with pytest.raises(KilledError):
        tune(dataclasses.replace(TINY, name="killed"))
    monkeypatch.setattr(tuning, "mean", true_mean)
    assert tune(dataclasses.replace(TINY, name="killed", resume=True)).name == whole.name
    one, other = (Path("runs") / name for name in ("tiny", "killed"))
    assert (one / "policy.txt").read_text() == (other / "policy.txt").read_text()
    # A validation that was not yet in a checkpoint is made, and written down, once more.
    tables = [columns(folder / "validation.csv", "steps", "measure") for folder in (one, other)]
    assert list(dict.fromkeys(tables[1])) == tables[0]


def test_train_tune_prints_a_name_that_bench_takes(capsys: Capsys) -> None:
    """A camera of 30 frames a second sends one in 50; twice as many cross well."""
    with pytest.raises(SystemExit) as ended:
        train.typed(["tune", "decimate:every=50", "--on=lte:duration_s=20", "--steps=100000", "--name=mine"])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    found = Path("runs/mine/policy.txt").read_text(encoding="utf-8").strip()
    assert found in printed and policies.get(found).parameters["every"] < 50
    assert "tuned" in printed and Path("runs/mine/results.txt").read_text(encoding="utf-8").strip() in printed
    refuse("mine exists: choose another --name", tune, dataclasses.replace(TINY, name="mine"))


def test_a_policy_of_ones_own_is_tuned(capsys: Capsys) -> None:
    """By hand: it drops the head of a full queue where ``first`` is above 2, else the newcomer, from a start of 1.9."""
    Path("own.py").write_text(
        "from bufgym import policies\n"
        "@policies.register('own-tuned', parameters={'first': 1.9}, compile=True)\n"
        "def own(buffer, arrival, memory):\n"
        "    if len(buffer.slots) < buffer.capacity:\n"
        "        return policies.ACCEPT\n"
        "    return 0 if buffer.parameters[0] > 2 else policies.REJECT\n"
    )
    settings = dataclasses.replace(
        TINY, rule="own-tuned", parameters=(), policy_file="own.py", name="own", steps=20_000
    )
    found = tune(settings)
    assert found.name.startswith("own-tuned:first=") and found.parameters["first"] > 2  # the head is the better one
    assert "runs/own" in capsys.readouterr().out


def test_one_recording_on_one_link_is_one_episode() -> None:
    rows = "".join(f"{k / 10},1000\n" for k in range(50))
    Path("drive.csv").write_text("time_s,bytes\n" + rows)
    task = Task.of(Place(workload="drive.csv", trace=("20kbit/s",), capacity=(4,)), policies.get("target-gap"))
    (only,) = task.training(0)
    assert task.is_once and [len(of.episodes[0].arrivals) for of in only] == [50]
    (judge,) = task.validation()
    assert (judge.episodes[0].arrivals["arrival_us"] == only[0].episodes[0].arrivals["arrival_us"]).all()


@pytest.mark.nightly
def test_the_rule_for_topics_is_found_again_from_twice_its_numbers() -> None:
    rule = policies.get("gap-priority")
    twice = rule.with_parameters(**{name: 2 * number for name, number in rule.parameters.items()})
    found = tune(Tune(rule=twice.name, place=Place(on="topics-v1"), name="twice"))
    judges = Task.of(Place(on="topics-v1"), rule).validation()
    assert tuning.mean(found, judges) < tuning.mean(twice, judges)

"""``bufgym.compare``: the same rows as the benchmark's, as text, Markdown, a data frame and a picture."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from refusal_cases import refused

import bufgym
from bufgym import policies, scenario
from bufgym.benchmark.run import run
from bufgym.ground import files
from bufgym.policies import REJECT, registry
from bufgym.scenario import FleetScenario


def stubborn(buffer, arrival, memory):
    """Rejects all, room or not."""
    return REJECT


def test_a_scenario_by_name_or_made_and_policies_of_each_kind() -> None:
    done = bufgym.compare(["afr", stubborn], "interruption", capacity=[2, 4], seeds=3, t_max=20, progress=False)
    made = scenario.get("interruption", t_max=20)
    rows = run([policies.get("afr"), policies.get(stubborn)], made, [2, 4], 3, label="interruption")
    unnamed = [{**row, "scenario": ""} for row in rows]
    assert done.rows == rows and bufgym.compare(["afr", stubborn], made, capacity=[2, 4], seeds=3).rows == unnamed
    # The score needs Drop Oldest on the same episodes, though it is no row.
    head, *lines = done.table().splitlines()
    assert head.split()[:5] == ["policy", "L", "score", "QoI", "regret"]
    assert [line.split()[0] for line in lines if line] == ["afr", "stubborn", "afr", "stubborn", "score:"]
    assert done.table("markdown").startswith("| policy | L |") and str(done).startswith("interruption\n\n")
    assert done._repr_html_().count("<tr>") == 5


def test_the_paired_difference_to_a_policy() -> None:
    """It, AFR and Drop Oldest run too; the difference is that of the two shares of AFR's regret."""
    options: dict[str, Any] = {"capacity": [4, 8], "seeds": 20, "progress": False}
    done = bufgym.compare("min-gap", "interruption", against="decimate:every=2", **options)
    assert {row["policy"] for row in done.rows} == {"min-gap", "decimate:every=2", "afr"}
    lines = [line.split() for line in done.table().split("\n\n")[-1].splitlines()]
    shares = {line[0]: line[1:] for line in lines[1:5]}
    assert set(shares) == {"min-gap", "decimate:every=2", "afr", "drop-oldest"} and shares["afr"][0] == "–"
    assert shares["decimate:every=2"][-1] == "–"
    less = float(shares["min-gap"][0]) - float(shares["decimate:every=2"][0])
    assert float(shares["min-gap"][3].replace("−", "-")) == pytest.approx(less, abs=0.0011)
    assert "| min-gap |" in done.table("markdown").split("\n\n")[-2] and done.html.count("<table>") == 2
    suite = bufgym.compare("afr", "interruption-v1", against="afr", capacity=4, seeds=3, progress=False)
    assert "minus afr's" in suite.table()
    fleet = FleetScenario(robots=2, uplink=scenario.get("lte", duration_s=5.0))
    assert "minus afr's" in bufgym.compare("min-gap", fleet, against="afr", seeds=1).table()


def test_a_policy_made_here_says_itself_that_it_does_not_compete() -> None:
    endless = policies.Policy("mine", policies.get("drop-oldest").on_arrival, unbounded=True)
    done = bufgym.compare([endless, "drop-oldest"], "interruption", seeds=2, t_max=20)
    assert done.unranked == {"mine": "its queue is unbounded"}
    assert [line.split()[0] for line in done.table().splitlines()[1:3]] == ["drop-oldest", "mine"]


def test_a_suite_takes_files_and_named_policies_and_those_registered_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A suite's processes load a file themselves; a policy registered in this process runs in this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    shipped = files.shipped("agents/named", "agents/pretrained/named", "*.safetensors")
    shutil.copy(shipped["learned-ppo"], "mine.safetensors")
    options: dict[str, Any] = {"capacity": 2, "seeds": 1, "progress": False}
    done = bufgym.compare([Path("mine.safetensors"), "learned-ppo"], "interruption-v1", **options)
    assert {row["policy"] for row in done.rows} == {"mine", "learned-ppo", "drop-oldest"}
    policies.register("stubborn")(stubborn)
    done = bufgym.compare(stubborn, "interruption-v1", **options)
    assert {row["policy"] for row in done.rows} == {"stubborn", "drop-oldest"}


def test_a_picture() -> None:
    pytest.importorskip("matplotlib", reason="a picture needs the extra [plot]")
    axes = bufgym.compare(["afr", "min-gap"], "interruption", capacity=[2, 4], seeds=2, progress=False).plot()
    assert {label.get_text() for label in axes.get_yticklabels()} == {"min-gap", "afr"}
    assert len(axes.patches) == 4 and axes.get_xlabel().startswith("regret")


def test_a_frame() -> None:
    frame = pytest.importorskip("pandas", reason="a frame needs pandas")
    found = bufgym.compare(["afr"], "interruption", seeds=2, progress=False).to_pandas()
    assert isinstance(found, frame.DataFrame) and found["policy"].tolist() == ["afr", "afr"]
    assert found["scenario"].tolist() == ["interruption", "interruption"]


@pytest.mark.parametrize(
    ("kind", "policy", "baseline", "head"),
    [("topics", "fifo", "robofleet", "QoI"), ("fleet", "min-gap", "afr", "team QoI")],
)
def test_topics_and_fleets_beside_their_baseline(kind: str, policy: str, baseline: str, head: str) -> None:
    made = scenario.get("topics", duration_s=2.0)
    if kind == "fleet":
        made = scenario.FleetScenario.of(2, "lte", duration_s=2.0)
    done = bufgym.compare([policy], made, capacity=4, seeds=1, about="mine")
    assert {row["policy"] for row in done.rows} == {policy, baseline}
    assert done.table().startswith("policy") and head in done.table() and done.to_pandas()["scenario"][0] == "mine"


def test_policies_from_names_functions_and_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    Path("mine.py").write_text("def every_other(buffer, arrival, memory):\n    return -1 if arrival.seq % 2 else -2\n")
    assert bufgym.make_policy("decimate:every=3").parameters["every"] == 3
    assert bufgym.make_policy(stubborn).name == "stubborn"
    assert bufgym.make_policy("mine:every_other").name == "every_other"
    assert bufgym.make_policy(policies.get("afr")).name == "afr"


test_what_is_wrong_is_named = refused(
    (lambda: bufgym.compare([stubborn], "outage-v1"), "policy stubborn: register it to run it on a suite"),
    (lambda: bufgym.compare([]), "policies = .*: need at least one"),
    (lambda: bufgym.compare(["afr"], "outage-v1", duration_s=3.0), "duration_s: a suite's episodes are frozen"),
    (
        lambda: bufgym.compare(["afr"], "interruption", seeds=1).table("html"),
        "form = 'html': must be 'plain' or 'markdown'",
    ),
)

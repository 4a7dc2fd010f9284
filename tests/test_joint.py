"""One agent for all links: its families, the fitness of a candidate, and the search from end to end, tiny."""

from pathlib import Path

import numpy as np
import pytest
from cli_cases import Patch
from train_cases import in_a_folder_of_its_own  # noqa: F401

from agents import families, joint
from agents.families import Family, run_of
from bufgym import policies
from bufgym.policies import guided, weights
from bufgym.scenario import Uplink
from bufgym.traces import Trace


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
    found, notes = weights.read_any(file)
    assert isinstance(found, guided.GuidedWeights) and 0 < np.abs(found.weight).max() < 1
    assert notes["training"] == "python -m agents.joint --seed 3 --generations 2"
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

"""Families of links: interruptions of every length at once; the page of the shipped agent."""

from pathlib import Path

import numpy as np
import pytest
from cli_cases import Patch
from refusal_cases import refuse

from agents.families import Family, run_of
from agents.mixed_env import Cell
from bufgym import policies
from bufgym.oracle import EveryLength, integer, law
from bufgym.policies import weights
from bufgym.policies.learned import Network, Weights
from bufgym.policies.ruled_network import RememberingWeights, seen
from bufgym.scenario import Interruption, Uplink
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace
from studies import families, learned

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


# The page of the agent for all links: its families, shares and intervals.


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


def test_the_page_compares_files_with_rules_and_an_older_agent(tmp_path: Path, monkeypatch: Patch) -> None:
    """By hand: the network of the files does what gap-price does, the older agent drops the cheapest."""
    few = runs()
    found = {"task": few, "default-frames": few}
    monkeypatch.setattr(learned, "families", lambda split, folder, data=None, leave_out=(): found)
    first = np.zeros((seen(3), 4), np.float32), np.zeros(4, np.float32)
    last = np.zeros((4, 6), np.float32), np.array([0, 0, 0, 0, 0, 1], np.float32)  # the sixth action is the rule's
    mine = RememberingWeights(3, True, True, "tanh", (first, last))
    reject = np.zeros((4, 6), np.float32), np.array([0, 1, 0, 0, 0, 0], np.float32)  # the cheapest goes, room or not
    old = RememberingWeights(3, True, True, "tanh", (first, reject))
    made, before = tmp_path / "mine.safetensors", tmp_path / "old.safetensors"
    weights.save(made, mine, {"name": "learned", "training": "python train.py hindsight --families all", "seeds": [3]})
    weights.save(before, old, {"name": "old"})
    learned.main(made, against=before, out=tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    family = Family("task", few)
    rule, older = (family.share(policy) for policy in (policies.get("gap-price"), policies.load(before)))
    rows = [row.strip("| ").split(" | ") for row in page.splitlines() if row.startswith("| task |")]
    assert older != rule and rows[0][3:] == [f"{rule:.3f}", f"{older:.3f}", f"{rule:.3f}"]
    assert rows[1][3] == "+0.000 [+0.000, +0.000]" and rows[1][4].startswith(f"{rule - older:+.3f}")
    assert [row.split(" |")[0] for row in page.splitlines() if row.startswith("| default")] == [
        f"| default-frames, L = {L}" for L in (4, 8)
    ] * 2
    assert "`python train.py hindsight --families all`, seed 3" in page and "hidden layers of 4, by tanh" in page


def test_who_names_no_network_is_told(tmp_path: Path) -> None:
    nothing = Network(np.zeros(1, np.float32), np.zeros(1, np.float32), (), np.zeros(0, np.float32))
    file = weights.save(tmp_path / "old.safetensors", Weights(("rank",), nothing, nothing), {"name": "old"})
    refuse("old.safetensors: is no network among candidates", learned.main, file)
    refuse("name at least one file", learned.main)


def test_every_family_is_drawn_anew_for_each_split(tmp_path: Path, monkeypatch: Patch) -> None:
    names = ("of_suite", "task", "default_frames", "random_streams")
    monkeypatch.setattr(families, "merged", lambda found, chosen=bool: [found])
    for name in names:
        monkeypatch.setattr(families, name, lambda split="", *rest, **options: {"split": split})
    assert len(families.families("test", tmp_path)) == len(list(tmp_path.glob("test-*.pkl"))) == 12


def test_random_streams_are_the_same_for_a_seed() -> None:
    one, again = (families.random_streams("validation", 3) for _ in range(2))
    assert [run["best"] for run in one] == [run["best"] for run in again]
    assert len({run["capacity"] for run in families.random_streams("test", 6)}) > 1

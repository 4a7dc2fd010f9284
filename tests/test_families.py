"""Families of links: interruptions of every length at once; the test of agents, and the page of the shipped one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_cases import Patch
from needs import needs
from refusal_cases import refuse

from agents import ready_families
from agents.families import Family
from agents.mixed_env import Cell
from bufgym import policies
from bufgym.jit import JIT
from bufgym.oracle import law
from bufgym.oracle.interruption import EveryLength, integer
from bufgym.policies import weights
from bufgym.policies.learned import Network, Weights
from bufgym.policies.ruled_network import RuledWeights, seen
from bufgym.scenario import Interruption, Uplink
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace, drive_motion, synthetic_lte
from studies import causal_planner, families, judging, learned
from studies.families import Maker, Place

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


# The test of agents for one queue: its runs, shares and intervals, and the page of the agent that ships.

LINKS = (Trace.steps([(1.0, 4e6), (1.0, 5e5)], name="a"), Trace.steps([(2.0, 3e6), (1.0, 1e6)], name="b"))


def places() -> list[Place]:
    """Two links that carry a third of 30 messages a second, for two L."""
    streams = [(link.name, Uplink(traces=(link,), duration_s=6.0)) for link in LINKS]
    return [Place(name, stream, L, B) for name, stream in streams for L, B in ((4, None), (8, 8 * 230_000))]


SMALL = Maker(places, 2)


def small(folder: Path, name: str = "small") -> Family:
    """Eight runs with their bounds: of link a at L = 4, then at L = 8, then of b."""
    return Family(name, families.bounded(name, SMALL, folder))


def test_shares_are_sums_over_the_links_drawn(tmp_path: Path) -> None:
    family, rule = small(tmp_path), policies.get("gap-price")
    afr, h = policies.get("afr"), family.play(rule)
    assert family.share(afr) == 1 and family.decisions == 8 * 180
    lost, of_afr = family.best - h, family.best - family.afr
    assert family.share(rule) == pytest.approx(lost.sum() / of_afr.sum())
    only_b = np.array([[0.0, 1.0]])  # the last four runs
    assert family.shares(h, only_b) == pytest.approx(lost[4:].sum() / of_afr[4:].sum())
    assert family.shares(h, only_b, family.capacity == 8) == pytest.approx(lost[6:].sum() / of_afr[6:].sum())
    (_, (alike, above)), (one, (below, _)) = family.against([rule, afr])
    assert alike == (0, 0, 0) and one == 1
    assert (above.value, above.low, above.high) == pytest.approx((-below.value, -below.high, -below.low))
    ratios = (1 - h / family.best + 0.01) / (1 - family.afr / family.best + 0.01)
    assert small(tmp_path, "random").share(rule) == pytest.approx(ratios.mean())


def moving(link: Trace, size_bytes: int) -> Uplink:
    """A camera on a drive."""
    return Uplink(traces=(link,), motion=(drive_motion(1),), duration_s=6.0, size_bytes=size_bytes)


def test_each_run_has_a_motion_a_jitter_and_an_offset_of_its_own() -> None:
    """Two links, frames of two sizes, three seeds: sizes share their draws, links and seeds do not."""
    streams = [Place(link.name, moving(link, size), 4) for size in (100_000, 200_000) for link in LINKS]
    runs = families.drawn(Maker(lambda: streams, 3))
    drives = {run["scenario"].motion[0].name for run in runs}
    seeds = [families.FIRST_RUN + k for k in (0, 1, 2, 16, 17, 18)]
    assert drives == {drive_motion(seed).name for seed in seeds}
    found = [(run["episode"].arrivals["arrival_us"].tobytes(), run["episode"].arrivals["x"].tobytes()) for run in runs]
    assert len(set(found)) == 6 and found[:6] == found[6:]
    offsets = [run["episode"].link.offset_us for run in runs]
    assert len(set(offsets[:6])) == 6 and offsets[:6] == offsets[6:]


def test_recorded_motion_stays() -> None:
    drive = drive_motion(2)
    recorded = Uplink(LINKS[:1], motion=(type(drive)("freiburg", drive.time_us, drive.coordinate),))
    assert families.moved(recorded, 9) is recorded
    assert families.moved(SHORT.scenario, 9) is SHORT.scenario


def id_of(trace: Trace) -> tuple[bytes, bytes]:
    """What tells links apart, whatever their names."""
    return trace.time_us.tobytes(), trace.cumulative_bytes.tobytes()


def test_no_row_is_on_links_motions_or_seeds_that_trained_or_chose_an_agent() -> None:
    cells = [
        cell for make in ready_families.FAMILIES.values() for part in ("train", "validation") for cell in make(part)
    ]
    known: list[Any] = [cell.scenario for cell in cells if isinstance(cell.scenario, Uplink)]
    links = {id_of(trace) for scenario in known for trace in scenario.traces}
    drives = {motion.name for scenario in known for motion in scenario.motion}
    ways = {trace.name.rsplit("-", 1)[0] for scenario in known for trace in scenario.traces}
    assert not ways & set(families.OTHER_WAYS) and {"foot", "car"} <= ways
    last = families.FIRST_RUN + 16 * 100
    assert not drives & {f"drive-{seed}" for seed in range(families.FIRST_RUN, last)} and "drive-20000" in drives
    for name, maker in families.FAMILIES.items():
        found = maker.places()
        assert len({place.link for place in found}) < 100 and 1 <= maker.seeds <= families.MOST_SEEDS
        if name != "interruption":
            assert not links & {id_of(trace) for place in found for trace in place.scenario.traces}, name
    assert {T % 5 for place in families.interruptions(1) for T in place.scenario.lengths} == {4}
    assert max(ready_families.FIRST_EPISODE.values()) + 100_000 < families.FIRST_RUN


def test_bounds_are_found_once_and_again_for_other_runs(tmp_path: Path, monkeypatch: Patch) -> None:
    first = families.bounded("small", SMALL, tmp_path)
    monkeypatch.setattr(families, "bound_of", lambda run: 7.0)
    assert [run["best"] for run in families.bounded("small", SMALL, tmp_path)] == [run["best"] for run in first]
    assert {run["best"] for run in families.bounded("small", Maker(places, 1), tmp_path)} == {7.0}
    assert len(list(tmp_path.iterdir())) == 2
    monkeypatch.setattr(families, "AT_ONCE", 3)
    assert [run["best"] for run in families.bounded("small", SMALL, tmp_path)] == [7.0] * 8
    assert len(list(tmp_path.iterdir())) == 2 + 3  # of three, three and two runs


def test_rows_are_families_and_their_parts(tmp_path: Path) -> None:
    """Of one policy by two names, each lies 0 above the other; "frames" has a row for each L."""
    runs = families.bounded("small", SMALL, tmp_path)
    rivals = {**judging.rules(), "copy": policies.get("gap-price"), "afr": policies.get("afr")}
    (row,), parts = judging.judged("small", runs, rivals)
    assert [part.name for part in parts] == ["small, L = 4", "small, L = 8"]
    assert (row.runs, row.links, parts[0].runs) == (8, 2, 4)
    assert row.above("copy", "gap-price") == (0, 0, 0) and row.share("afr").value == 1
    h, family = Family("", runs).play(policies.get("gap-price")), Family("", runs)
    lost, of_afr = (family.best - h)[family.capacity == 4], (family.best - family.afr)[family.capacity == 4]
    assert parts[0].share("copy").value == pytest.approx(lost.sum() / of_afr.sum())
    assert row.shares[row.best_rule][0] == min(row.shares[rule][0] for rule in judging.RULES)
    by_capacity = judging.judged("frames", runs, rivals)
    assert [part.name for part in by_capacity.rows] == ["frames, L = 4", "frames, L = 8"] and not by_capacity.parts
    mean = judging.mean_of(parts)
    assert mean.share("copy").value == pytest.approx(np.mean([part.shares["copy"][0] for part in parts]))
    assert (mean.runs, mean.links) == (8, 2)


def test_the_page_compares_files_with_rules_and_an_older_agent(tmp_path: Path, monkeypatch: Patch) -> None:
    """By hand: the network of the file does what gap-price does, the older agent drops the cheapest."""
    found = {"task": SMALL, "frames": SMALL}
    monkeypatch.setattr(families, "chosen", lambda data=None, only=(): found)
    first = np.zeros((seen(3), 4), np.float32), np.zeros(4, np.float32)
    last = np.zeros((4, 6), np.float32), np.array([0, 0, 0, 0, 0, 1], np.float32)  # the sixth action is the rule's
    mine = RuledWeights(3, True, True, "tanh", (first, last))
    reject = np.zeros((4, 6), np.float32), np.array([0, 1, 0, 0, 0, 0], np.float32)  # the cheapest goes, room or not
    old = RuledWeights(3, True, True, "tanh", (first, reject))
    made, before = tmp_path / "mine.safetensors", tmp_path / "old.safetensors"
    weights.save(made, mine, {"name": "learned", "training": "python train.py hindsight --families all", "seeds": [3]})
    weights.save(before, old, {"name": "old"})
    learned.main(made, against=before, folder=tmp_path / "kept", out=tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    family = small(tmp_path / "kept")
    rule, older = (family.share(policy) for policy in (policies.get("gap-price"), policies.load(before)))
    (share, above, told), frames, again = (
        [row.strip("| ").split(" | ") for row in page.splitlines() if row.startswith(start)]
        for start in ("| task |", "| frames, L = ", "| task, L = ")
    )
    assert share[:3] == ["task", "8", "2"] and share[5] == f"{rule:.3f}" and share[6].startswith(f"{rule:.3f} [")
    assert older != rule and share[7] == f"{older:.3f}" and above[3].startswith(f"{rule - older:+.3f} [")
    assert len(frames) == 4 and len(again) == 2
    assert told[:2] == ["task", f"{rule:.3f}"] and len(told) == 4
    assert f"python -m studies.learned {made} --against {before}" in page
    assert "`python train.py hindsight --families all`, seed 3" in page and "hidden layers of 4, by tanh" in page


def test_two_files_of_one_name_are_told_apart_and_a_page_needs_a_network(tmp_path: Path) -> None:
    nothing = Network(np.zeros(1, np.float32), np.zeros(1, np.float32), (), np.zeros(0, np.float32))
    file = weights.save(tmp_path / "old.safetensors", Weights(("rank",), nothing, nothing), {"name": "old"})
    refuse("old.safetensors: is no network among candidates", learned.main, file, out=tmp_path / "page.md")
    other = tmp_path / "b" / file.name
    other.parent.mkdir()
    other.write_bytes(file.read_bytes())
    assert list(learned.named([file, other])) == [str(file), str(other)]
    assert list(learned.named([file])) == ["old"]


def test_families_are_all_but_those_whose_bounds_take_minutes() -> None:
    refuse("unknown family 'wifi'", families.chosen, None, ("wifi",))
    assert [*families.chosen(), "unequal"] == sorted(families.FAMILIES, key="unequal".__eq__)
    assert list(families.chosen(None, ("unequal", "task"))) == ["unequal", "task"]
    assert list(families.chosen("DIR"))[-1] == "uplinks"


@pytest.mark.skipif(not JIT, reason=needs("compiled", "without compilation a plan takes seconds"))
def test_the_planner_plays_some_runs_once(tmp_path: Path, monkeypatch: Patch) -> None:
    """On two of three links, one of two seeds each: it is better than the rule, and a stopped run goes on."""
    links = [synthetic_lte(seed, mean_bytes_per_s=6e6, mode="train") for seed in range(3)]
    streams = [Place(f"{k}", moving(link, 2_000_000), 4) for k, link in enumerate(links)]
    maker = Maker(lambda: streams, 2)
    monkeypatch.setitem(families.FAMILIES, "lte", maker)
    plan = judging.Plan("lte", causal_planner.Planning(8, 6.0, True), 2, 1, 4)
    monkeypatch.setattr(judging, "PLANS", {"lte": plan, "task": plan._replace(family="task")})
    runs = {"lte": families.bounded("lte", maker, tmp_path)}
    (row,) = judging.planned(runs, tmp_path, judging.rules())
    assert (row.name, row.runs, row.links) == ("lte", 2, 2)
    assert 0 < row.share(causal_planner.NAME).value < row.share("target-gap").value
    files = sorted(tmp_path.glob("planner-*.npy"))
    assert len(files) == 2
    files[0].unlink()
    played = list[int]()

    def counted(run: Any, *rest: Any) -> float:
        played.append(run["capacity"])
        return causal_planner.qoi_of(run, *rest)

    monkeypatch.setattr(judging, "qoi_of", counted)
    (again,) = judging.planned(runs, tmp_path, judging.rules())
    assert len(played) == 1 and (again.shares[causal_planner.NAME] == row.shares[causal_planner.NAME]).all()


def test_random_streams_are_the_same_for_a_seed_and_of_equal_sizes() -> None:
    one, again = (families.random_streams(6) for _ in range(2))
    assert [place.capacity for place in one] == [place.capacity for place in again]
    assert len({place.capacity for place in one}) > 1 and {place.scenario.sizes for place in one} == {"equal"}

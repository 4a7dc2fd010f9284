"""The benchmark of fleets: rows of a cell worked by hand, statistics of rows made by hand, the command."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bufgym import policies
from bufgym.benchmark import fleets
from bufgym.benchmark.bootstrap import Interval
from bufgym.benchmark.fleets import ROWS, fleet_parts, run_parts
from bufgym.benchmark.fleets_summary import Standing, plain, summary
from bufgym.benchmark.rows import Row, read_rows, write_rows
from bufgym.benchmark.run import draw, run
from bufgym.cli import main
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.scenario import FleetScenario, Uplink, suites
from bufgym.traces import Trace

STEADY = Trace.constant(1000.0, 60.0, name="1 kB/s")
ONE = Uplink((STEADY,), rate_hz=1, size_bytes=1000, jitter=0, duration_s=3.0, random_offset=False, propagation_us=0)
ONE = replace(ONE, value=qoi.exponential(0.5))
"""A frame each second, which takes a second where the robot has 1 kB/s for itself; each further one is worth 1/2."""


def met(robots: int, uplink: Uplink, policy: str = "drop-newest", capacity: int = 1) -> list[Row]:
    return run_parts([policies.get(policy)], fleet_parts("hand", FleetScenario(robots, uplink), [[0]]), [capacity])


def test_rows_of_a_cell_worked_by_hand() -> None:
    """Two robots over 1 kB/s together (half of what a fleet of two has): each frame takes 2 s, so that frame 1, waiting
    from 1 s on, begins at 2 s as frame 2 arrives, which then waits until 4 s. All three arrive, at 2, 4 and 6 s."""
    rows = met(2, replace(ONE, scale=0.5))
    assert [tuple(row) for row in rows] == [ROWS.columns] * 2
    key = {"scenario": "hand", "trace": "1 kB/s", "seed": 0, "robots": 2, "policy": "drop-newest", "capacity": 1}
    assert [key | {"robot": robot} for robot in (0, 1)] == [
        {name: row[name] for name in ROWS.columns[:7]} for row in rows
    ]
    for row in rows:
        assert (row["arrived"], row["delivered"], row["dropped"], row["buffered"]) == (3, 3, 0, 0)
        assert row["qoi"] == pytest.approx(1 + 2 * 0.5)
        assert row["mean_sojourn_s"] == pytest.approx((2 + 3 + 4) / 3)
    # A quarter each: frame 0 takes 4 s, frame 1 waits, frame 2 finds the buffer full.
    for row in met(2, replace(ONE, scale=0.25)):
        assert (row["delivered"], row["dropped"], row["qoi"]) == (2, 1, pytest.approx(1.5))


def test_a_fleet_of_one_has_the_rows_of_the_benchmark_for_one() -> None:
    uplink = replace(ONE, scale=0.3, duration_s=40.0, random_offset=True, jitter=0.5)
    chosen = [policies.get(name) for name in ("afr", "random")]
    mine = run_parts(chosen, fleet_parts("s", FleetScenario(1, uplink), [[3, 8]]), [2, 4])
    alone = run(chosen, uplink, [2, 4], [3, 8], label="s", bound=False)
    names = [name for name in ROWS.columns if name not in ("robots", "robot")]
    place = ("capacity", "policy", "seed")
    for rows in (mine, alone):
        rows.sort(key=lambda row: [row[name] for name in place])
    assert [[row[name] for name in names] for row in mine] == [[row[name] for name in names] for row in alone]


def test_every_policy_and_capacity_meets_the_same_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = fleets.suite_parts(fleets.get("fleet-v1"), "validation", seeds=2, robots=3)[:2]
    parts = [
        part._replace(fleet=replace(part.fleet, uplink=replace(part.fleet.uplink, duration_s=1.0))) for part in parts
    ]
    chosen = [policies.get(name) for name in ("afr", "random")]
    rows = run_parts(chosen, parts, [2, 4])
    assert len(rows) == 2 * 2 * 2 * 2 * 3  # traces, seeds, capacities, policies, robots
    alone = run_parts(chosen[1:], parts[1:], [4])
    last = [row for row in rows if (row["trace"], row["policy"], row["capacity"]) == (parts[1].trace, "random", 4)]
    assert repr(last) == repr(alone)
    # One episode at a time: the same rows, each once.
    monkeypatch.setattr("bufgym.benchmark.run._BATCH_MESSAGES", 1)
    assert sorted(map(repr, run_parts(chosen, parts, [2, 4]))) == sorted(map(repr, rows))


# -------------------- fleet-v1


@pytest.mark.parametrize("split", suites.SPLITS)
def test_fleet_v1_is_lte_v1_with_sixteen_robots(split: str) -> None:
    """Each robot alone would meet what lte-v1's motion setting has: traces, motions, streams, V."""
    alone = suites.get("lte-v1").settings(split)["motion"].scenario
    assert isinstance(alone, Uplink)
    parts = fleets.suite_parts(fleets.get("fleet-v1"), split)
    assert [part.trace for part in parts] == [trace.name for trace in alone.traces]
    for k, part in enumerate(parts):
        assert part.fleet == FleetScenario(16, replace(alone, traces=(alone.traces[k],)))
        assert list(part.seeds) == [1000 * k + s for s in range(5)]


def test_splits_share_no_trace_and_no_motion() -> None:
    found = [
        [part.fleet.uplink for part in fleets.suite_parts(fleets.get("fleet-v1"), split)] for split in suites.SPLITS
    ]
    for kind in ("traces", "motion"):
        names = [{recording.name for uplink in split for recording in getattr(uplink, kind)} for split in found]
        assert sum(map(len, names)) == len(set.union(*names))


def test_robots_of_an_episode_tick_together_and_move_each_on_its_own() -> None:
    part = fleets.suite_parts(fleets.get("fleet-v1"), "test", seeds=1, robots=4)[0]
    episode, again = (fleets.draw(part.fleet, part.seeds[0]) for _ in range(2))
    assert episode.ticks_together and episode.robots == 4
    assert all((a == b).all() for a, b in zip(episode.arrivals, again.arrivals, strict=True))
    assert len({float(arrivals["x"][-1]) for arrivals in episode.arrivals}) == 4
    # The first robot's stream is the one that the seed stands for in the benchmark of one robot.
    alone = draw(part.fleet.uplink, part.seeds[0])
    assert (episode.arrivals[0]["x"] == alone.arrivals["x"]).all()


def test_who_runs_by_default() -> None:
    names = fleets.default_policies()
    assert {"afr", "drop-oldest", "learned-motion"} <= set(names) and len(set(names)) == len(names)
    assert not {"clairvoyant", "rosbridge", "robofleet"} & set(names)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lte-v1", "suite lte-v1 has one robot, not a fleet: bufgym bench --suite lte-v1"),
        ("topics-v1", "suite topics-v1 has one robot, not a fleet: bufgym topics --suite topics-v1"),
        ("fleet-v9", "unknown suite 'fleet-v9' of a fleet; known: fleet-v1"),
    ],
)
def test_other_suites_are_refused(name: str, message: str) -> None:
    with pytest.raises(BufgymError, match=message):
        fleets.get(name)


# -------------------- the summary


def made(policy: str, *teams: tuple[float, ...], capacity: int = 4, scenario: str = "s") -> list[Row]:
    """Rows of one policy: H of each robot, episode by episode."""
    return [
        {"scenario": scenario, "trace": "t", "seed": seed, "policy": policy, "capacity": capacity, "robot": r, "qoi": h}
        for seed, team in enumerate(teams)
        for r, h in enumerate(team)
    ]


def exactly(x: float) -> Interval:
    """Of a statistic that every episode agrees on."""
    return Interval(pytest.approx(x), pytest.approx(x), pytest.approx(x))


def of(standings: list[Standing], policy: str) -> Standing:
    (found,) = (standing for standing in standings if standing.policy == policy)
    return found


HAND = [*made("afr", (4.0, 2.0), (8.0, 6.0)), *made("mine", (7.0, 1.0), (8.0, 8.0))]


def test_a_summary_worked_by_hand() -> None:
    """Teams of 3 and 7 under AFR become 4 and 8: one robot of each episode is above its own H, one of four below."""
    found = summary(HAND)
    assert [standing.policy for standing in found.overall] == ["mine", "afr"]
    mine, base = found.overall
    assert found.cells == {("s", 4): [mine, base]}
    assert (mine.team.value, base.team.value) == (6.0, 5.0) and mine.team.low == 4.0 and mine.team.high == 8.0
    assert mine.gain == exactly(1.0) and base.gain == exactly(0.0)
    assert mine.above == exactly(0.5) and base.above == base.below == exactly(0.0)
    assert mine.below.value == 0.25
    assert mine.worst.value == (1 + 8) / 2 and base.worst.value == (2 + 6) / 2
    # 64 / (2 x 50) and 1; 36 / (2 x 20) and 196 / (2 x 100).
    assert mine.fairness.value == pytest.approx((0.64 + 1) / 2)
    assert base.fairness.value == pytest.approx((0.9 + 0.98) / 2)


def test_intervals_are_over_episodes_not_robots() -> None:
    """A hundred robots that all gain alike are one observation: two episodes cannot make the interval narrow."""
    many = 100
    rows = [*made("afr", (1.0,) * many, (1.0,) * many), *made("mine", (1.0,) * many, (3.0,) * many)]
    mine = of(summary(rows).overall, "mine")
    assert mine.gain == (1.0, 0.0, 2.0) and mine.above == (0.5, 0.0, 1.0)


def test_intervals_are_paired_and_repeatable() -> None:
    """Episodes differ far more than the two policies do in any of them."""
    base = [(10.0, 12.0), (100.0, 80.0), (50.0, 40.0), (20.0, 22.0)]
    theirs = [(a + 1 + k / 10, b + 1) for k, (a, b) in enumerate(base)]
    rows = [*made("afr", *base), *made("mine", *theirs)]
    mine = of(summary(rows, seed=1).overall, "mine")
    assert 1.0 <= mine.gain.low < mine.gain.value < mine.gain.high <= 1.15
    assert of(summary(rows[::-1], seed=1).overall, "mine") == mine


def test_over_all_cells_it_is_the_mean_of_theirs() -> None:
    more = [*made("afr", (1.0, 1.0), (1.0, 1.0), capacity=9), *made("mine", (4.0, 4.0), (4.0, 4.0), capacity=9)]
    found = summary([*HAND, *more])
    assert list(found.cells) == [("s", 4), ("s", 9)]
    mine = of(found.overall, "mine")
    assert mine.gain == exactly((1 + 3) / 2) and mine.above == exactly((0.5 + 1) / 2)


def test_rounding_is_no_gain_and_nothing_is_fair() -> None:
    nothing = (0.0, 0.0)
    each = {"afr": (0.1 + 0.2, 0.0), "mine": (0.3, 0.0), "none": nothing}
    rows = [row for policy, team in each.items() for row in made(policy, team, team)]
    found = summary(rows).overall
    assert of(found, "mine").above == of(found, "mine").below == exactly(0.0)
    assert of(found, "none").fairness == exactly(1.0) and of(found, "none").below == exactly(0.5)


def test_unranked_policies_come_last() -> None:
    rows = [*made("afr", (1.0,)), *made("endless", (9.0,))]
    assert [s.policy for s in summary(rows).overall] == ["endless", "afr"]
    assert [s.policy for s in summary(rows, unranked=["endless"]).overall] == ["afr", "endless"]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "no rows"),
        (HAND[4:], "s, L = 4: no row of the baseline 'afr'"),
        (HAND[:-1], "mine and afr at s, L = 4: robot 1 of trace t, seed 1, met by one of both alone"),
        ([HAND[0], HAND[0]], r"rows\[1\]: robot 0 of one run has more than one row"),
        ([{**HAND[0], "qoi": None}], r"rows\[0\]: no qoi"),
        (made("afr", (1.0, 2.0), (1.0,)), "not every episode has the same robots"),
        ([*HAND, *made("afr", (1.0,), capacity=9)], "mine: no row at s, L = 9"),
    ],
)
def test_rows_that_cannot_be_summed_up(rows: list[Row], message: str) -> None:
    with pytest.raises(BufgymError, match=message):
        summary(rows)


def test_the_table_as_text() -> None:
    more = [*made("afr", (1.0,), (1.0,), capacity=9), *made("mine", (4.0,), (4.0,), capacity=9)]
    lines = plain(summary([*HAND, *more]), {"s": "a story"}).splitlines()
    assert lines[0].split("  ")[0] == "policy" and "- afr's [95 %]" in lines[0]
    assert lines[2] == "s: a story, L = 4" and lines[6] == "s: a story, L = 9" and lines[10] == "mean of these 2"
    assert lines[3].split()[:4] == ["mine", "6.000", "+1.000", "[+1.000,"]
    assert lines[3].split()[5:] == ["50.0%", "[50.0%,", "50.0%]", "25.0%", "4.500", "0.8200"]
    assert lines[4].split() == ["afr", "5.000", "4.000", "0.9400"]


def test_one_episode_has_no_interval() -> None:
    line = plain(summary([*made("afr", (1.0, 2.0)), *made("mine", (4.0, 2.0))])).splitlines()[3]
    assert line.split() == ["mine", "3.000", "+1.500", "[-]", "50.0%", "[-]", "0.0%", "2.000", "0.9000"]


# -------------------- the command


@pytest.mark.slow
def test_decisions_that_cannot_be_carried_out_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(
        "from bufgym.policies import ACCEPT, register\n"
        "@register('far-off', on_send=lambda buffer, memory: 999)\n"
        "def far_off(buffer, arrival, memory):\n"
        "    return ACCEPT if len(buffer.slots) < buffer.capacity else 0\n"
    )
    out = tmp_path / "rows.csv"
    options = ["--robots", "1", "--seeds", "1", "--capacity", "3", "--split", "validation", "--out", str(out)]
    try:
        assert main(["fleet", "--policy", "far-off", "--policy-file", str(mine), *options]) == 0
    finally:
        policies.registry._REGISTRY.pop("far-off", None)
    told = capsys.readouterr().out
    invalid = sum(row["invalid"] for row in read_rows(out, ROWS) if row["policy"] == "far-off")
    assert invalid > 0 and f"note: far-off gave {invalid} invalid decisions\n" in told


@pytest.mark.slow
def test_the_command_prints_a_table_and_writes_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rows.csv"
    options = ["--robots", "2", "--seeds", "1", "--capacity", "3", "--split", "validation", "--out", str(out)]
    assert main(["fleet", "--policy", "drop-oldest,min-gap", *options]) == 0
    told = capsys.readouterr().out
    assert "6 episodes of 60 s on 6 links, 2 robots in a cell (not the suite as it is: it has 16)." in told
    assert "motion, L = 3" in told and "mean of these" not in told
    rows = read_rows(out, ROWS)
    # AFR runs, named or not.
    assert len(rows) == 6 * 2 * 3 and {row["policy"] for row in rows} == {"drop-oldest", "min-gap", "afr"}
    found = summary(rows).overall
    shown = re.findall(r"^(\S+) +([\d.]+) ", told[told.index("motion, L = 3") :], re.MULTILINE)[: len(found)]
    assert shown == [(standing.policy, f"{standing.team.value:.3f}") for standing in found]
    assert [repr(row) for row in read_rows(write_rows(rows, out, ROWS), ROWS)] == [repr(row) for row in rows]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--policy", "clairvoyant"],
            "policy clairvoyant: it plans with a link of its own, which no robot in a cell has",
        ),
        (["--policy", "afr", "afr"], "'afr' is given more than once"),
        (["--suite", "lte-v1"], "suite lte-v1 has one robot, not a fleet"),
        (["--split", "dev"], "split = 'dev': must be one of train, validation, test"),
        (["--robots", "0"], "must be a whole number >= 1"),
        (["--robots", "257"], "robots = 257: must be a whole number from 1 to 256"),
        (["--seeds", "1001"], "seeds = 1001: must lie between 1 and 1000"),
        (["--capacity", "5,5"], "5 is given more than once"),
        (["--out", "rows.txt"], "rows are written to .csv or .parquet files"),
        (["--out", "nowhere/rows.csv"], "no folder to write this file to"),
    ],
)
def test_mistakes_end_in_one_line(options: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fleet", *options]) == 2
    told: Any = capsys.readouterr()
    assert told.out == "" and message in told.err and told.err.count("\n") == 1

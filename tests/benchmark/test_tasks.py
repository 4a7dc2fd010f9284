"""The tasks of several topics and of a fleet: rows of an episode worked by hand, statistics of rows made by hand."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_cases import shown
from refusal_cases import refused
from sweep_cases import exactly

from bufgym import policies
from bufgym.benchmark.rows import Row, read_rows
from bufgym.benchmark.run import run
from bufgym.benchmark.summary import table_of
from bufgym.benchmark.tasks import TASKS, topics
from bufgym.benchmark.tasks.fleet import ROWS as FLEET_ROWS
from bufgym.benchmark.tasks.topics import ROWS
from bufgym.model import qoi
from bufgym.model.topics import Topic
from bufgym.scenario import Client, FleetScenario, Stream, Uplink
from bufgym.sim.metrics import TopicOutcome
from bufgym.traces import Trace

TASK = TASKS["topics"]

POSE = Stream(Topic("pose", priority=3, deadline_s=0.5), rate_hz=2, size_bytes=100, jitter=0)
MAP = Stream(Topic("map", no_drop=True), rate_hz=1, size_bytes=1000, jitter=0)
LINK = Trace.constant(1000.0, 60.0, name="1 kB/s")
NUMBERS = {"duration_s": 2.0, "random_offset": False, "propagation_us": 0}
CLIENT = Client((POSE, MAP), (LINK,), value=qoi.exponential(0.618), **NUMBERS)
"""Poses at 0, 0.5, 1 and 1.5 s that take 0.1 s each, maps at 0 and 1 s that take 1 s each."""


T_OF_TWO = 12.706
"""Student's t of 95 % with one degree of freedom, that of two episodes."""


def met(policy: str, client: Client = CLIENT, capacity: int = 16) -> dict[str, Row]:
    return {row["topic"]: row for row in run([policies.get(policy)], client, [capacity], 1, label="hand")}


def test_rows_of_an_episode_worked_by_hand() -> None:
    """First in, first out: pose 0 crosses at 0.1 s, map 0 at 1.1, poses 1 and 2 at 1.2 and 1.3, map 1 at 2.3, pose 3
    at 2.4. Poses take 0.1, 0.7, 0.3 and 0.9 s from their arrival, maps 1.1 and 1.3 s."""
    rows = met("fifo")
    pose, map_ = rows["pose"], rows["map"]
    assert list(pose) == list(ROWS)
    key = {"scenario": "hand", "trace": "1 kB/s", "seed": 0, "window": 1, "consumers": 1, "policy": "fifo"}
    assert key.items() <= pose.items() and {"capacity": 16, "priority": 3.0, "weight": 3.0}.items() <= pose.items()
    assert (pose["no_drop"], map_["no_drop"]) == (False, True)
    assert (pose["deadline_s"], map_["deadline_s"]) == (0.5, None)
    assert (pose["arrived"], pose["delivered"], pose["late"]) == (4, 4, 2)
    assert (map_["arrived"], map_["delivered"], map_["late"], map_["bytes_delivered"]) == (2, 2, 0, 2000)
    assert pose["mean_sojourn_s"] == pytest.approx(0.5) and map_["mean_sojourn_s"] == pytest.approx(1.2)
    # x counts the messages: each further one is worth 1 - 0.618.
    assert pose["qoi"] == pytest.approx(1 + 3 * 0.382) and map_["qoi"] == pytest.approx(1 + 0.382)
    assert pose["weighted_qoi"] == map_["weighted_qoi"] == pytest.approx(3 * 2.146 + 1.382)
    assert pose["seconds"] == map_["seconds"] == 2.4
    # Until the last arrival at 1.5 s: the age of poses grows to 1.2, falls to 0.7, at 1.3 to 0.3; that of maps to 1.5.
    assert pose["mean_age_s"] == pytest.approx((1.2**2 / 2 + 0.075 + 0.08) / 1.5)
    assert (pose["peak_age_s"], map_["peak_age_s"]) == pytest.approx((1.2, 1.5))
    assert map_["mean_age_s"] == pytest.approx(0.75)


def test_copies_are_folded_back_into_their_topic() -> None:
    """Two consumers, whose connections take turns. Poses to the first cross at 0.1, 1.2, 3.4 and 4.6 s, to the second
    at 1.3, 3.5, 4.7 and 4.8, with a map before or between: 1.575 s a pose to the one, 2.825 s to the other."""
    rows = met("ros-native", replace(CLIENT, consumers=2))
    assert list(rows) == ["pose", "map"]
    assert rows["pose"]["consumers"] == 2 and rows["pose"]["seconds"] == 4.8
    assert rows["pose"]["mean_sojourn_s"] == pytest.approx((1.575 + 2.825) / 2)
    assert (rows["pose"]["arrived"], rows["pose"]["delivered"]) == (4, 4)
    # Both get all of it: the weights of the copies add up to the topic's.
    assert rows["pose"]["weighted_qoi"] == pytest.approx(3 * 2.146 + 1.382)
    # One in all for a policy that sends no copies.
    assert met("fifo", replace(CLIENT, consumers=2))["pose"]["seconds"] == 2.4


def test_folding_takes_means_of_what_is_known() -> None:
    one = TopicOutcome("a to 1", 2.0, 10, 2, 1, 7, 0, 200, 0.5, 0.9, 1.0, 4.0, 1)
    other = replace(one, topic="a to 2", qoi=3.0, delivered=3, lost=6, mean_sojourn_s=math.nan, late=0)
    folded = topics._folded([one, other])
    assert (folded["qoi"], folded["delivered"], folded["lost"], folded["late"]) == (2.5, 2.5, 6.5, 0.5)
    assert repr(folded["arrived"]) == "10"
    assert folded["mean_sojourn_s"] == 0.5


def test_a_full_buffer_and_a_rate_limit_show() -> None:
    """L = 1: while map 0 crosses until 1.1 s, pose 1 waits, pose 2 takes its place, and map 1, no_drop, pose 2's.
    Pose 3 waits from 1.5 s on while map 1 crosses."""
    rows = met("fifo", capacity=1)
    assert (rows["pose"]["lost"], rows["pose"]["delivered"]) == (2, 2)
    assert (rows["map"]["lost"], rows["map"]["delivered"]) == (0, 2)
    limited = replace(POSE, topic=replace(POSE.topic, rate_limit_hz=1))
    rows = met("fifo", replace(CLIENT, streams=(limited, MAP)))
    assert (rows["pose"]["limited"], rows["pose"]["lost"], rows["pose"]["delivered"]) == (2, 0, 2)


def made(policy: str, seed: int, weighted_qoi: float, scenario: str = "s", **first: Any) -> list[Row]:
    """The rows of one run of 10 s with a topic of priority 5 (changed by ``first``), one of 1, and one no_drop."""
    key = {"scenario": scenario, "trace": "t", "seed": seed, "policy": policy, "capacity": 4}
    run = {"weighted_qoi": weighted_qoi, "seconds": 10.0, "invalid": 0}
    rest = {"qoi": 1.0, "arrived": 9, "delivered": 4.0, "limited": 0.0, "lost": 0.0, "late": 0.0, "mean_age_s": 2.0}
    rest |= {"peak_age_s": 3.0, "mean_sojourn_s": 0.5, "p95_sojourn_s": math.nan, "no_drop": False, "deadline_s": 1.0}
    return [
        {**key, "topic": "first", "priority": 5.0, **rest, **run, **first},
        {**key, "topic": "second", "priority": 1.0, **rest, **run, "mean_age_s": 6.0, "lost": 5.0},
        {**key, "topic": "kept", "priority": 1.0, **rest, **run, "no_drop": True, "deadline_s": None, "lost": 2.0},
    ]


HALF = [
    row
    for seed, h in enumerate((10.0, 40.0, 30.0))
    for row in [*made("robofleet", seed, 2 * h), *made("mine", seed, h, mean_age_s=1.0, late=1.0)]
]
"""A policy that has half of the baseline's QoI in each episode, whatever the episode."""


def test_a_summary_worked_by_hand() -> None:
    found = TASK.summary(HALF)
    base, mine = found.overall
    assert (base.policy, mine.policy) == ("robofleet", "mine")
    assert found.cells == {("s", 4): [base, mine]}
    assert found.quantities[3].title == "age, priority 5 (s)"
    # 80 / 160 in all, and half in every resample.
    assert mine["relative"] == exactly(0.5) and base["relative"] == exactly(1.0)
    value, low, high = mine["qoi"]
    assert value == pytest.approx(80 / 3) and low < 80 / 3 < high
    assert mine["age_first_s"] == exactly(1.0) and base["age_first_s"] == exactly(2.0)
    # (6 + 2) / 2; two lost of the no_drop topic in each of three episodes, those of "second" do not count.
    assert mine["age_others_s"] == exactly(4.0) and mine["lost"] == exactly(6)
    # One late of 4 + 4 with a deadline; 12 delivered in 10 s.
    assert mine["late"] == exactly(1 / 8) and base["late"] == exactly(0.0) and mine["rate_hz"] == exactly(1.2)


def test_unknown_ages_are_left_out() -> None:
    rows = [*made("robofleet", 0, 1.0, mean_age_s=math.nan), *made("robofleet", 1, 1.0, mean_age_s=3.0)]
    assert TASK.summary(rows).overall[0]["age_first_s"] == exactly(3.0)
    same = [{**row, "priority": 1.0, "deadline_s": None} for row in made("robofleet", 0, 0.0)]
    (standing,) = TASK.summary(same).overall
    assert math.isnan(standing["age_others_s"].value) and math.isnan(standing["late"].value)
    assert math.isnan(standing["relative"].value)  # of nothing
    assert "  –  " in table_of(TASK.summary(same)).plain()


FLEET = TASKS["fleet"]

STEADY = Trace.constant(1000.0, 60.0, name="1 kB/s")
ONE = Uplink((STEADY,), rate_hz=1, size_bytes=1000, jitter=0, duration_s=3.0, random_offset=False, propagation_us=0)
ONE = replace(ONE, value=qoi.exponential(0.5))
"""A frame each second, which takes a second where the robot has 1 kB/s for itself; each further one is worth 1/2."""


def met_in_a_cell(robots: int, uplink: Uplink, policy: str = "drop-newest", capacity: int = 1) -> list[Row]:
    return run([policies.get(policy)], FleetScenario(robots, uplink), [capacity], 1, label="hand")


def test_rows_of_a_cell_worked_by_hand() -> None:
    """Two robots over 1 kB/s together (half of what a fleet of two has): each frame takes 2 s, so that frame 1, waiting
    from 1 s on, begins at 2 s as frame 2 arrives, which then waits until 4 s. All three arrive, at 2, 4 and 6 s."""
    rows = met_in_a_cell(2, replace(ONE, scale=0.5))
    assert [list(row) for row in rows] == [list(FLEET_ROWS)] * 2
    key = {"scenario": "hand", "trace": "1 kB/s", "seed": 0, "robots": 2, "policy": "drop-newest", "capacity": 1}
    assert [key | {"robot": i} for i in (0, 1)] == [{name: row[name] for name in list(FLEET_ROWS)[:7]} for row in rows]
    for row in rows:
        assert (row["arrived"], row["delivered"], row["dropped"], row["buffered"]) == (3, 3, 0, 0)
        assert row["qoi"] == pytest.approx(1 + 2 * 0.5)
        assert row["mean_sojourn_s"] == pytest.approx((2 + 3 + 4) / 3)
    # A quarter each: frame 0 takes 4 s, frame 1 waits, frame 2 finds the buffer full.
    for row in met_in_a_cell(2, replace(ONE, scale=0.25)):
        assert (row["delivered"], row["dropped"], row["qoi"]) == (2, 1, pytest.approx(1.5))


def team_rows(policy: str, *teams: tuple[float, ...], capacity: int = 4, scenario: str = "s") -> list[Row]:
    return [
        {"scenario": scenario, "trace": "t", "seed": seed, "policy": policy, "capacity": capacity, "robot": r, "qoi": h}
        for seed, team in enumerate(teams)
        for r, h in enumerate(team)
    ]


TEAMS = [*team_rows("afr", (4.0, 2.0), (8.0, 6.0)), *team_rows("mine", (7.0, 1.0), (8.0, 8.0))]


def test_a_summary_of_teams_worked_by_hand() -> None:
    """Teams of 3 and 7 under AFR become 4 and 8: one robot of each episode is above its own H, one of four below."""
    found = FLEET.summary(TEAMS)
    assert [standing.policy for standing in found.overall] == ["mine", "afr"]
    mine, base = found.overall
    assert found.cells == {("s", 4): [mine, base]}
    # Two episodes of 4 and 8: drawn means are 4, 6, 6 or 8, so the standard error is sqrt(2) sqrt(2) = 2.
    assert mine["team"] == pytest.approx((6.0, 0.0, 6.0 + 2 * T_OF_TWO), rel=0.03)  # no H is below 0
    assert base["team"].value == 5.0
    assert mine["gain"] == exactly(1.0) and base["gain"] == exactly(0.0)
    assert mine["above"] == exactly(0.5) and base["above"] == base["below"] == exactly(0.0)
    assert mine["below"].value == 0.25
    assert mine["worst"].value == (1 + 8) / 2 and base["worst"].value == (2 + 6) / 2
    # 64 / (2 x 50) and 1; 36 / (2 x 20) and 196 / (2 x 100).
    assert mine["fairness"].value == pytest.approx((0.64 + 1) / 2)
    assert base["fairness"].value == pytest.approx((0.9 + 0.98) / 2)


def test_intervals_are_over_episodes_not_robots() -> None:
    """A hundred robots that all gain alike are one observation: two episodes cannot make the interval narrow."""
    many = 100
    rows = [*team_rows("afr", (1.0,) * many, (1.0,) * many), *team_rows("mine", (1.0,) * many, (3.0,) * many)]
    mine = FLEET.summary(rows).standings["mine"]
    assert mine["gain"] == pytest.approx((1.0, 1 - T_OF_TWO, 1 + T_OF_TWO), rel=0.03)
    assert mine["above"] == (0.5, 0.0, 1.0)  # and not beyond, as a share of robots


def test_rounding_is_no_gain_and_nothing_is_fair() -> None:
    teams = {"afr": (0.1 + 0.2, 0.0), "mine": (0.3, 0.0), "none": (0.0, 0.0)}
    found = FLEET.summary([row for policy, team in teams.items() for row in team_rows(policy, team, team)]).standings
    assert found["mine"]["above"] == found["mine"]["below"] == exactly(0.0)
    assert found["none"]["fairness"] == exactly(1.0) and found["none"]["below"] == exactly(0.5)


test_rows_that_cannot_be_summed_up = refused(
    (lambda: FLEET.summary([]), "no rows"),
    (lambda: FLEET.summary(TEAMS[:-1]), "mine at s, L = 4, trace t, seed 1: robot 1 is not in every episode"),
    (lambda: FLEET.summary([TEAMS[0], TEAMS[0]]), r"rows\[1\]: robot 0 of one run has more than one row"),
    (lambda: FLEET.summary([{**TEAMS[0], "qoi": None}]), r"rows\[0\]: no qoi"),
)


@pytest.mark.nightly
def test_the_command_prints_a_table_and_writes_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rows.csv"
    options = "--seeds 1 --capacity 3 --split validation --policies drop-oldest,min-gap --jobs 1"
    text = shown(["bench", "--suite", "fleet-v1", *options.split(), "--out", out], capsys)
    assert "6 episodes of 60 s on 6 links, 16 robots in a cell." in text
    assert ", L = 3\n" in text and "mean of these" not in text and f"288 rows in {out}" in text
    rows = read_rows(out, FLEET_ROWS)
    assert len(rows) == 6 * 16 * 3 and {row["policy"] for row in rows} == {"drop-oldest", "min-gap", "afr"}
    assert table_of(FLEET.summary(rows)).plain().splitlines()[3:] == text.splitlines()[6:9]

"""The task of a fleet: rows of a cell worked by hand, statistics of rows made by hand, the command."""

from dataclasses import replace
from pathlib import Path

import pytest
from cli_cases import shown
from refusal_cases import refused
from sweep_cases import exactly

from bufgym import policies
from bufgym.benchmark.rows import Row, read_rows
from bufgym.benchmark.run import run
from bufgym.benchmark.summary import table_of
from bufgym.benchmark.tasks import TASKS
from bufgym.benchmark.tasks.fleet import ROWS
from bufgym.model import qoi
from bufgym.scenario import FleetScenario, Uplink
from bufgym.traces import Trace

TASK = TASKS["fleet"]

STEADY = Trace.constant(1000.0, 60.0, name="1 kB/s")
ONE = Uplink((STEADY,), rate_hz=1, size_bytes=1000, jitter=0, duration_s=3.0, random_offset=False, propagation_us=0)
ONE = replace(ONE, value=qoi.exponential(0.5))
"""A frame each second, which takes a second where the robot has 1 kB/s for itself; each further one is worth 1/2."""


def met(robots: int, uplink: Uplink, policy: str = "drop-newest", capacity: int = 1) -> list[Row]:
    return run([policies.get(policy)], FleetScenario(robots, uplink), [capacity], 1, label="hand")


def test_rows_of_a_cell_worked_by_hand() -> None:
    """Two robots over 1 kB/s together (half of what a fleet of two has): each frame takes 2 s, so that frame 1, waiting
    from 1 s on, begins at 2 s as frame 2 arrives, which then waits until 4 s. All three arrive, at 2, 4 and 6 s."""
    rows = met(2, replace(ONE, scale=0.5))
    assert [list(row) for row in rows] == [list(ROWS)] * 2
    key = {"scenario": "hand", "trace": "1 kB/s", "seed": 0, "robots": 2, "policy": "drop-newest", "capacity": 1}
    assert [key | {"robot": i} for i in (0, 1)] == [{name: row[name] for name in list(ROWS)[:7]} for row in rows]
    for row in rows:
        assert (row["arrived"], row["delivered"], row["dropped"], row["buffered"]) == (3, 3, 0, 0)
        assert row["qoi"] == pytest.approx(1 + 2 * 0.5)
        assert row["mean_sojourn_s"] == pytest.approx((2 + 3 + 4) / 3)
    # A quarter each: frame 0 takes 4 s, frame 1 waits, frame 2 finds the buffer full.
    for row in met(2, replace(ONE, scale=0.25)):
        assert (row["delivered"], row["dropped"], row["qoi"]) == (2, 1, pytest.approx(1.5))


def made(policy: str, *teams: tuple[float, ...], capacity: int = 4, scenario: str = "s") -> list[Row]:
    return [
        {"scenario": scenario, "trace": "t", "seed": seed, "policy": policy, "capacity": capacity, "robot": r, "qoi": h}
        for seed, team in enumerate(teams)
        for r, h in enumerate(team)
    ]


HAND = [*made("afr", (4.0, 2.0), (8.0, 6.0)), *made("mine", (7.0, 1.0), (8.0, 8.0))]


def test_a_summary_worked_by_hand() -> None:
    """Teams of 3 and 7 under AFR become 4 and 8: one robot of each episode is above its own H, one of four below."""
    found = TASK.summary(HAND)
    assert [standing.policy for standing in found.overall] == ["mine", "afr"]
    mine, base = found.overall
    assert found.cells == {("s", 4): [mine, base]}
    assert mine["team"] == (6.0, 4.0, 8.0) and base["team"].value == 5.0
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
    rows = [*made("afr", (1.0,) * many, (1.0,) * many), *made("mine", (1.0,) * many, (3.0,) * many)]
    mine = TASK.summary(rows).standings["mine"]
    assert mine["gain"] == (1.0, 0.0, 2.0) and mine["above"] == (0.5, 0.0, 1.0)


def test_rounding_is_no_gain_and_nothing_is_fair() -> None:
    teams = {"afr": (0.1 + 0.2, 0.0), "mine": (0.3, 0.0), "none": (0.0, 0.0)}
    found = TASK.summary([row for policy, team in teams.items() for row in made(policy, team, team)]).standings
    assert found["mine"]["above"] == found["mine"]["below"] == exactly(0.0)
    assert found["none"]["fairness"] == exactly(1.0) and found["none"]["below"] == exactly(0.5)


test_rows_that_cannot_be_summed_up = refused(
    (lambda: TASK.summary([]), "no rows"),
    (lambda: TASK.summary(HAND[:-1]), "mine at s, L = 4, trace t, seed 1: robot 1 is not in every episode"),
    (lambda: TASK.summary([HAND[0], HAND[0]]), r"rows\[1\]: robot 0 of one run has more than one row"),
    (lambda: TASK.summary([{**HAND[0], "qoi": None}]), r"rows\[0\]: no qoi"),
)


@pytest.mark.nightly
def test_the_command_prints_a_table_and_writes_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rows.csv"
    options = "--robots 2 --seeds 1 --capacity 3 --split validation --policies drop-oldest,min-gap --jobs 1"
    text = shown(["fleet", *options.split(), "--out", out], capsys)
    assert "6 episodes of 60 s on 6 links, 2 robots in a cell." in text
    assert "Not the suite as it is: robots = 2." in text
    assert ", L = 3\n" in text and "mean of these" not in text and f"36 rows in {out}" in text
    rows = read_rows(out, ROWS)
    assert len(rows) == 6 * 2 * 3 and {row["policy"] for row in rows} == {"drop-oldest", "min-gap", "afr"}
    assert table_of(TASK.summary(rows)).plain().splitlines()[3:] == text.splitlines()[7:10]

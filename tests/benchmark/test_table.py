"""The table, worked by hand."""

from __future__ import annotations

import math
from typing import Any

from bufgym.benchmark import table


def row(policy: str, capacity: int, qoi: float, **more: Any) -> dict[str, Any]:
    rest = dict.fromkeys([column.key for column in table.COLUMNS], 1.0)
    return {**rest, "policy": policy, "capacity": capacity, "qoi": qoi, "regret": None, "invalid": 0, **more}


ROWS = [
    row("b", 5, 2.0, delivered=3, mean_sojourn_s=0.5),
    row("b", 5, 4.0, delivered=4, mean_sojourn_s=math.nan),
    row("a", 5, 6.0),
    row("a", 2, 1.0),
    row("c", 2, 1.0, invalid=3),
]


def test_means_leave_out_what_is_missing_and_come_best_first() -> None:
    entries = table.means(ROWS)
    found = [(e["capacity"], e["policy"], e["qoi"]) for e in entries]
    assert found == [(2, "a", 1.0), (2, "c", 1.0), (5, "a", 6.0), (5, "b", 3.0)]
    assert (entries[3]["delivered"], entries[3]["mean_sojourn_s"]) == (3.5, 0.5)
    assert math.isnan(entries[3]["regret"])


def test_plain_text_is_aligned_and_says_what_was_invalid() -> None:
    lines = table.plain(ROWS).split("\n")
    assert lines[0].split()[:4] == ["policy", "L", "QoI", "delivered"] and "regret" not in lines[0]
    assert lines[3] == ""  # between capacities
    body = [line for line in lines[:6] if line]
    assert len({len(line) for line in body}) == 1 and body[-1].split()[:4] == ["b", "5", "3.000", "3.5"]
    assert lines[-1] == "note: c gave 3 invalid decisions"
    rows = [row("a", 1, 2.0, regret=0.125), row("b", 1, 1.0, mean_sojourn_s=math.nan)]
    head, a, b = table.plain(rows).split("\n")
    assert "regret" in head and "12.50%" in a and b.split().count("-") == 2


def test_markdown() -> None:
    lines = table.markdown([row("a", 1, 2.0)]).split("\n")
    assert lines[0].startswith("| policy | L | QoI | delivered |")
    assert lines[1].count("---:") == lines[0].count("|") - 2
    assert lines[2] == "| a | 1 | 2.000 | 1.0 | 1.0 | 1.000 | 1.000 | 1.000 | 1.000 | 1.000 | 1.000 |"


def scored(policy: str, seed: int, qoi: float, best: float = 9.0, **more: Any) -> dict[str, Any]:
    more = {"trace": "t", "seed": seed, "clairvoyant": best, "regret": 1 - qoi / best, **more}
    return row(policy, 8, qoi, **more)


BASE = [scored("drop-oldest", 0, 4.0, delivered=3), scored("drop-oldest", 1, 5.0)]
MINE = [scored("mine", 0, 6.0), scored("mine", 1, 7.0, best=11.0)]


def test_the_score_leads_and_is_computed_on_sums() -> None:
    """Drop Oldest has 4 + 5, the clairvoyant 9 + 11, mine 6 + 7: (13 - 9) / (20 - 9); an unbounded queue has none."""
    free = [scored("rosbridge", seed, 12.0, regret=None) for seed in (0, 1)]
    entries = {entry["policy"]: entry["score"] for entry in table.means([*BASE, *MINE, *free])}
    assert entries["mine"] == 4 / 11 and entries["drop-oldest"] == 0 and math.isnan(entries["rosbridge"])
    lines = table.plain([*BASE, *MINE, *free]).split("\n")
    assert lines[0].split()[:5] == ["policy", "L", "score", "QoI", "regret"]
    assert lines[1].split()[:4] == ["mine", "8", "0.364", "6.500"]
    assert "score" not in table.plain(MINE)
    assert table.plain(MINE, BASE).split("\n")[1].split()[2] == "0.364"
    assert "drop-oldest" not in table.plain(MINE, BASE)


def test_policies_that_no_row_tells_apart_are_one_line() -> None:
    twins = [{**entry, "policy": name} for entry in BASE for name in ("ros-keep-last", "near")]
    twins[-1] |= {"delivered": 2}
    rows = [*twins, *BASE, *MINE]
    assert table.same(rows) == {"drop-oldest": ["ros-keep-last"]}
    lines = table.plain(rows).split("\n")
    assert [line.split()[0] for line in lines[1:4]] == ["mine", "drop-oldest", "near"]
    assert lines[4] == "note: ros-keep-last: the same rows here as drop-oldest"
    assert "| drop-oldest |" in table.markdown(rows) and "| ros-keep-last |" not in table.markdown(rows)
    # One that does not compete is a line of its own, whatever its rows.
    unbounded = [{**entry, "policy": "rosbridge"} for entry in BASE]
    assert table.same([*BASE, *unbounded]) == {}

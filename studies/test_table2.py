"""Robofleet's Table II: two programs that really run, and what is said of their costs."""

import sys

import pytest
from needs import needs

from bufgym.utils.errors import BufgymError
from bufgym_papers.figures import figure
from bufgym_papers.figures.rows import FigureRows
from studies import robofleet_table2, table2_programs

for library in ("rosbags", "flatbuffers", "roslibpy", "websockets"):
    pytest.importorskip(library, reason=needs("extras", library))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason=needs("system", "/proc"))
def test_both_programs_send_clouds_and_say_what_it_cost() -> None:
    """Robofleet's rule may drop some on a busy machine; the other keeps all."""
    rows = figure("robofleet-table2", runs=1, seconds=0.5, points=100).simulate()
    assert [row["program"] for row in rows] == ["robofleet", "rosbridge"]
    assert 1 <= rows[0]["received"] <= rows[1]["received"] == 5
    for row in rows:
        assert row["cpu"] > 0 and row["virtual_mb"] > row["resident_mb"] > 10, row["program"]


def test_a_claim_holds_if_it_does_in_every_run() -> None:
    table = figure("robofleet-table2", runs=2)
    costs = {"robofleet": ((0.02, 500), (0.04, 500)), "rosbridge": ((0.3, 400), (0.03, 1_600))}
    rows = FigureRows(
        {"program": program, "run": run, "cpu": cpu, "virtual_mb": mb, "resident_mb": 50.0, "received": 150}
        for program, runs in costs.items()
        for run, (cpu, mb) in enumerate(runs)
    )
    facts = table.claims(rows)
    assert (facts["cpu"], facts["cpu_ratio"]) == (False, "5.5")  # 16.5 against 3 %, but once 4 against 3 %
    assert (facts["robofleet_mb"], facts["rosbridge_mb"]) == ("500 MB", "1,000 MB")
    calm = FigureRows(row for row in rows if row["cpu"] != 0.03)
    assert table.claims(calm)["cpu"]
    line = "Robofleet 3.0 ± 1.0 % 500.0 ± 0.0 MB 50.0 ± 0.0 MB 150 of 150 1.3 %, 452.5 MB 15.1 %, 425.6 MB"
    assert " ".join(table.tables(rows)[1].split()) == line


def test_a_program_that_cannot_start_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table2_programs, "__file__", "no_such_program.py")
    with pytest.raises(BufgymError, match=r"robofleet-table2: robofleet: .*no_such_program"):
        figure("robofleet-table2", runs=1).simulate()
    monkeypatch.setattr(robofleet_table2.sys, "platform", "darwin")
    with pytest.raises(BufgymError, match="virtual memory is read from /proc"):
        figure("robofleet-table2").simulate()

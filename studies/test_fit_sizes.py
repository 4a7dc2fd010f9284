"""The fit finds the laws of message sizes again, in tables, workloads and shipped sequences."""

from pathlib import Path

import numpy as np
import pytest

from bufgym import traces
from bufgym.traces.generate import sizes
from bufgym.traces.generate.sizes import Moving, drawn, parsed
from bufgym.utils.errors import BufgymError
from studies.fit_sizes import fits, laws, main

DRIVE = traces.load_motion("drive-0")


@pytest.mark.parametrize(
    ("law", "name", "numbers"),
    [
        ("jpeg:rho=0.9,cv=0.3,noise=0.15", "jpeg", {"rho": 0.9, "cv": 0.3, "noise": 0.15}),
        ("gop:every=12,ratio=5,rho=0.8,cv=0.2,noise=0.1", "gop", {"every": 12, "ratio": 5, "cv": 0.2, "noise": 0.1}),
        ("depth-colour:rho=0.9,cv=0.3", "depth-colour", {"ratio": 4, "rho": 0.9, "cv": 0.3, "noise": 0.05}),
        ("motion:exponent=0.4,noise=0.1", "motion", {"exponent": 0.4, "noise": 0.1}),
    ],
)
def test_a_fit_finds_the_law_again(law: str, name: str, numbers: dict[str, float]) -> None:
    times = np.arange(20_000, dtype=np.int64) * 33_333
    sizes_drawn = drawn(law, 20_000, 100_000, np.random.default_rng(3), Moving(DRIVE, times))
    found = {parsed(text)[0]: parsed(text)[1] for text in laws(sizes_drawn, times, DRIVE.at(times))}
    for key, value in numbers.items():
        assert found[name][key] == pytest.approx(value, rel=0.1, abs=0.01)
    assert laws(np.full(200, 5)) == ["equal"]


def test_fit_reads_tables_workloads_and_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "t.csv"
    table.write_text("a,b\n" + "".join(f"{100 + k % 7},{50 + 100 * (k % 2)}\n" for k in range(200)))
    assert list(sizes.read_sizes(table)) == ["a", "b"] and fits(table)["b"][0].startswith("depth-colour:ratio=3,")
    main(str(table), "7scenes-h264")
    assert "gop:every=30,ratio=5.32" in capsys.readouterr().out
    workload = tmp_path / "w.csv"
    workload.write_text("time_s,bytes\n" + "".join(f"{k},{100 + k % 5}\n" for k in range(50)))
    with pytest.raises(BufgymError, match="no topic has the 100 messages"):
        fits(workload)

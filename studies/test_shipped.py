"""The files that bufgym ships are what their generators make."""

from pathlib import Path
from typing import Any

from bufgym import traces
from bufgym.traces import describe, load, load_motion, synthetic_lte
from bufgym.traces.generate.driving import drive_motion
from bufgym.traces.shipped import shipped_calls
from studies.shipped import main

ROOT = Path(__file__).resolve().parents[1]


def test_the_calls_that_are_stated_make_the_shipped_files_byte_for_byte(tmp_path: Path) -> None:
    main(tmp_path)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert made == {path.name: path.read_bytes() for path in (ROOT / "traces").glob("*.csv")}
    assert set(shipped_calls()) == set(traces.shipped()) == {name.removesuffix(".csv") for name in made}
    for name, call in shipped_calls().items():
        generated: Any = eval(call, {"synthetic_lte": synthetic_lte, "drive_motion": drive_motion})
        if name.startswith("drive-"):
            assert load_motion(name).coordinate.tolist() == generated.coordinate.tolist()
        else:
            assert load(name).cumulative_bytes.tolist() == generated.cumulative_bytes.tolist()
            # They trouble a robot, but not always: 30 frames of 230 kB a second.
            assert 3 <= describe(load(name))["seconds_below_500KBps"] <= 45

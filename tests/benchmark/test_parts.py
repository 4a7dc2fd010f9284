"""A scenario in several processes: the rows of one process, in their order, and mistakes that say what they are."""

from pathlib import Path
from typing import Any

import pytest
from cli_cases import Patch
from needs import needs
from refusal_cases import refuse, refused
from sweep_cases import ended

import bufgym
from bufgym import policies, scenario
from bufgym.benchmark.parts import run_parts
from bufgym.benchmark.run import run
from bufgym.scenario import Uplink
from bufgym.traces import Trace

pytest.importorskip("joblib", reason=needs("extras", "joblib"))

TWINS = Uplink(traces=(Trace.constant(2e6, 9, name="same"), Trace.constant(1e6, 9, name="same")), duration_s=2)
MINE = """
def mine(buffer, arrival, memory):
    return {} if len(buffer.slots) == buffer.capacity else -2
"""


def stubborn(buffer: Any, arrival: Any, memory: Any) -> int:
    return -2 if len(buffer.slots) < buffer.capacity else -1


@pytest.mark.parametrize("made", [TWINS, scenario.get("topics", duration_s=0.5)], ids=["queue", "topics"])
def test_rows_are_those_of_one_process_in_their_order(made: Any) -> None:
    """12 seeds are parts of ten and two on each trace, and the second of two traces of one name keeps its number."""
    chosen = [policies.get(name) for name in (("random", "afr") if made is TWINS else ("fifo", "robofleet"))]
    seeds = 12 if made is TWINS else 2
    together = run_parts(chosen, made, [4, 3], seeds, jobs=2, backend="threading", label="x")
    assert repr(together) == repr(run(chosen, made, [4, 3], seeds, label="x"))


def test_other_processes_know_a_modules_policy(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lab.py").write_text(MINE.format("0"))
    words = ["bench", "--policies", "afr,lab:mine", "--seconds", "1", "--seeds", "1", "--out"]
    for jobs in (1, 2):
        code, _, complaint = ended(*words, f"{jobs}.csv", "--jobs", jobs)
        assert code == 0, complaint
    assert Path("1.csv").read_bytes() == Path("2.csv").read_bytes()


def test_a_mistake_in_a_policy_names_its_line(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.py").write_text(MINE.format("1 // 0"))
    place = r"bad.py, line 3: ZeroDivisionError"
    refuse(place, bufgym.compare, "bad:mine", "interruption", seeds=30, jobs=2, backend="threading", progress=False)


test_what_is_wrong_is_named = refused(
    (lambda: bufgym.compare("afr", "interruption", jobs=0), "jobs = 0: must be a whole number >= 1, or -1"),
    (lambda: bufgym.compare("afr", "interruption", backend="no"), "backend = 'no': must be one of loky, "),
    (lambda: bufgym.compare(stubborn, "interruption", jobs=2), "policy stubborn: known to this process alone: jobs"),
)

"""The experiment: common random numbers, the oracle's column, one episode in full; rows in files, to the last bit."""

import itertools
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from needs import needs
from refusal_cases import refuse, refused

import bufgym
from bufgym import policies
from bufgym.benchmark import run
from bufgym.benchmark.rows import RUNS, Row, read_rows, write_rows
from bufgym.benchmark.tasks.queue import QueueTask, row_to_show
from bufgym.model import qoi
from bufgym.oracle.interruption import integer
from bufgym.policies import Policy
from bufgym.scenario import Interruption, Uplink, numbered
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import replaced

SLOW = Trace.steps([(1.0, 300_000), (1.0, 0)], name="slow")
FAST = Trace.steps([(1.0, 9_000_000)], name="fast")
UPLINK = Uplink(traces=(SLOW, FAST), rate_hz=10, duration_s=2, size_bytes=100_000)


def spy(name: str, log: list[Any]) -> Policy:
    def on_arrival(buffer: Any, arrival: Any, memory: Any) -> int:
        log.append((int(arrival.seq), int(arrival.arrival_us), int(arrival.size_bytes), float(arrival.uniform)))
        return policies.REJECT

    return Policy(name, on_arrival)


def test_every_policy_and_capacity_meets_the_same_episodes() -> None:
    first: list[Any] = []
    second: list[Any] = []
    run.run([spy("one", first), spy("two", second)], replace(UPLINK, size_cv=0.5), [2, 5], 3)
    assert first == second
    half = len(first) // 2
    assert half == 2 * 3 * 20  # traces x seeds x messages
    # Traces come one after the other, capacities within them.
    per = 3 * 20
    assert first[:per] == first[per : 2 * per]
    assert len({uniform for *_, uniform in first[:per]}) == per


def test_a_seed_means_the_same_episode_in_any_company(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = [policies.get("random"), policies.get("afr")]
    rows = run.run(chosen, UPLINK, [1, 3], 4)
    alone = run.run([policies.get("random")], replace(UPLINK, traces=(FAST,)), [3], [2])
    wanted = ("random", 3, "fast", 2)
    assert alone == [row for row in rows if (row["policy"], row["capacity"], row["trace"], row["seed"]) == wanted]
    monkeypatch.setattr(run, "_BATCH_MESSAGES", 41)  # two episodes of 20
    assert sorted(map(repr, run.run(chosen, UPLINK, [1, 3], 4))) == sorted(map(repr, rows))


def test_every_trace_is_met_on_its_own_even_under_one_name() -> None:
    parts = numbered.by_trace(replace(UPLINK, traces=(SLOW, FAST, SLOW, SLOW)))
    assert [label for label, _ in parts] == ["slow", "fast", "slow#2", "slow#3"]
    assert all(len(part.traces) == 1 for _, part in parts if isinstance(part, Uplink))


def test_an_interruption_has_a_bound_and_a_regret() -> None:
    """T = 3, L = 1: message 0 is sent, of 1, 2, 3 one is kept, and message 4 comes after.

    V = min(1, d / 4): drop-oldest keeps 3, H = 1 + 3/4 + 1/4 = 2, the clairvoyant 1 + 2/4 + 2/4 as well: regret 0.
    V = min(1, d / 2): drop-oldest 1 + 1 + 1/2, the clairvoyant 1 + 1 + 1: regret (3 - 2.5) / 3.
    """
    for distance, best, regret in ((4, 2.0, 0.0), (2, 3.0, 1 / 6)):
        v = qoi.saturating(distance)
        scenario = Interruption(law="fixed", t_max=3, value=v)
        (row,) = run.run([policies.get("drop-oldest")], scenario, [1], 1, label="short")
        assert list(row) == list(RUNS)
        assert (row["scenario"], row["trace"]) == ("short", "interruption")
        assert row["clairvoyant"] == best == 1 + integer(1, 3, v)
        assert row["certified"] is True
        assert row["regret"] == pytest.approx(regret)
        assert (row["arrived"], row["delivered"], row["dropped"]) == (5, 3, 2)


def test_bounds_that_are_not_asked_for_or_do_not_hold() -> None:
    (row,) = run.run([policies.get("afr")], replace(UPLINK, traces=(FAST,)), [2], 1, bound=False)
    assert row["clairvoyant"] is None and row["certified"] is None and row["regret"] is None
    (free,) = run.run([policies.get("rosbridge")], replace(UPLINK, traces=(SLOW,)), [2], 1)
    assert free["clairvoyant"] > 0 and free["regret"] is None  # L does not bind it
    assert free["dropped"] == 0 and free["peak_backlog_bytes"] > 2 * 100_000
    dead = replace(UPLINK, traces=(Trace.steps([(1.0, 1), (1.0, 0)], name="dead", after="stop"),))
    (nothing,) = run.run([policies.get("afr")], dead, [2], 1)
    assert (nothing["qoi"], nothing["clairvoyant"], nothing["regret"]) == (0, 0, 0)


def test_where_only_a_full_buffer_asks_the_bound_is_an_upper_one() -> None:
    asked = run.run([policies.get("clairvoyant")], replace(UPLINK, traces=(SLOW,)), [2], 3)
    assert all(row["certified"] and row["regret"] == pytest.approx(0, abs=1e-12) for row in asked)
    rows = run.run([policies.get("drop-oldest")], replace(UPLINK, traces=(SLOW,)), [2], 3, decide_at="overflow")
    assert not any(row["certified"] for row in rows)
    assert [row["clairvoyant"] for row in rows] == [row["clairvoyant"] for row in asked]


def newest(buffer: Any, arrival: Any, memory: Any) -> int:
    return policies.ACCEPT if len(buffer.slots) < buffer.capacity else 0


AFR = policies.get("afr")

test_bad_arguments_are_named = refused(
    (lambda: run.run([AFR], UPLINK, [0], 1), "capacity = 0"),
    (lambda: run.run([AFR], UPLINK, [2], 0), "seeds = 0"),
    (lambda: run.run([AFR, AFR], UPLINK, [2], 1), "'afr' is given more than once"),
    (lambda: run.run([AFR], UPLINK, [2], 1, decide_at="never"), "'never'"),
    (lambda: bufgym.compare([AFR], "topics", max_bytes=5), "max_bytes = 5: is for one queue, not for topics"),
    (lambda: bufgym.compare([3], UPLINK), "policy 3: must be a name, a Policy, or a function"),  # type: ignore[list-item]
    (
        lambda: run.run([Policy("afr", newest), AFR], UPLINK, [2], 1),
        "'afr' is given more than once; 'afr' is a built-in policy's name",
    ),
)


def test_functions_and_names_are_policies_too() -> None:
    rows = bufgym.compare([newest, "drop-oldest", AFR], UPLINK, capacity=2, seeds=1, progress=False).rows
    qoi_of = {row["policy"]: row["qoi"] for row in rows if row["trace"] == "slow"}
    assert list(qoi_of) == ["newest", "drop-oldest", "afr"] and qoi_of["newest"] == qoi_of["drop-oldest"]


CHOSEN = [policies.get(spec) for spec in ("drop-oldest", "afr", "random", "codel", "clairvoyant", "rosbridge")]
GAPS = Trace.steps([(1.0, 600_000), (2.0, 0), (1.0, 250_000)], name="gappy")
GAPPY = Uplink(traces=(GAPS,), rate_hz=10, duration_s=6, size_bytes=50_000)
STOPS = replace(GAPPY, traces=(Trace.steps([(2.0, 300_000), (2.0, 20_000)], name="stops", after="stop"),))
"""Here the link ends for good: a message hangs in transmission and others stay queued."""


@pytest.mark.parametrize("scenario", [GAPPY, STOPS, Interruption(t_max=30, value=qoi.saturating(4))])
def test_every_message_is_accounted_for_as_in_the_rows(scenario: Any) -> None:
    rows = run.run(CHOSEN, scenario, [3], [1003], label="here")
    made = QueueTask().timeline(CHOSEN, scenario, rows[0])
    assert json.loads(json.dumps(made, allow_nan=False)) == made
    assert (made["scenario"], made["capacity"], made["seed"]) == ("here", 3, 1003)
    assert list(made["policies"]) == [policy.name for policy in CHOSEN]
    messages = len(made["arrival_s"])
    for row in rows:
        lane = made["policies"][row["policy"]]
        received, dropped = [k for k, _, _ in lane["received"]], [k for k, _ in lane["dropped"]]
        assert not set(received) & set(dropped)
        assert len(set(received)) == len(received) == row["delivered"] and len(dropped) == row["dropped"]
        left = messages - len(received) - len(dropped)
        assert row["arrived"] == messages and left == row["in_transmission"] + row["buffered"]
        assert lane["qoi"] == pytest.approx(row["qoi"], rel=1e-12)
        assert lane["regret"] == (None if row["regret"] is None else pytest.approx(row["regret"], abs=1e-12))
        # H once more, from the picture alone.
        x = [made["x"][k] for k in sorted(received)]
        gains = sum(scenario.value(b - a) for a, b in itertools.pairwise(x))
        assert lane["qoi"] == pytest.approx(1 + gains if x else 0.0)
        assert all(made["arrival_s"][k] <= dequeued <= transmitted for k, dequeued, transmitted in lane["received"])
        assert all(made["arrival_s"][k] <= when for k, when in lane["dropped"])
    assert scenario is not STOPS or any(row["in_transmission"] and row["buffered"] for row in rows)


def test_the_episode_shown_is_the_one_that_costs_drop_oldest_most_at_the_middle_capacity() -> None:
    given = [("drop-oldest", 2, 0, 0.9), ("drop-oldest", 4, 0, 0.2), ("drop-oldest", 4, 1, 0.3)]
    given += [("drop-oldest", 4, 2, None), ("afr", 4, 3, 0.8), ("drop-oldest", 8, 0, 0.7)]
    names = ("policy", "capacity", "seed", "regret")
    rows = [dict(zip(names, cells, strict=True), scenario="s", trace="t") for cells in given]
    assert row_to_show(rows) == row_to_show(rows[::-1]) == rows[2]
    assert row_to_show(rows[3:4]) is None


ENDINGS = ["csv", "parquet"]


def row(**changed: Any) -> Row:
    cells = {str: "{0} text".format, bool: lambda _, __: True, int: lambda _, k: k, float: lambda _, k: k / 7}
    return {name: cells[kind](name, k) for k, (name, kind) in enumerate(RUNS.items())} | changed


HARD = [
    row(),
    row(qoi=0.1 + 0.2, regret=5e-324, mean_age_s=1.7976931348623157e308, peak_backlog_bytes=2**62 + 1),
    row(mean_sojourn_s=math.nan, clairvoyant=None, certified=None, regret=None),
    row(certified=False, regret=-0.0, longest_gap=math.inf, seed=2**53 + 1),
    row(scenario='a, "quoted"\nlabel', trace="Übertragung;\t'x'", policy="decimate:every=2,phase=1"),
    row(scenario="", qoi=3.0),
]
"""Numbers that need all their bits, nothing in all its forms, text that a CSV must quote."""


def layout(ending: str) -> str:
    if ending == "parquet":
        pytest.importorskip("pyarrow", reason=needs("extras", "pyarrow"))
    return ending


@pytest.mark.parametrize("ending", ENDINGS)
def test_rows_come_back_to_the_last_bit(tmp_path: Path, ending: str) -> None:
    path = write_rows(HARD, tmp_path / f"rows.{layout(ending)}")
    # repr tells None from NaN, 3 from 3.0, 0.0 from -0.0, and shows every bit of a float.
    assert [repr(same) for same in read_rows(path)] == [repr(given) for given in HARD]
    assert list(tmp_path.iterdir()) == [path]  # nothing temporary stays
    assert write_rows(read_rows(path), tmp_path / f"again.{ending}").read_bytes() == path.read_bytes()
    assert read_rows(write_rows([], path)) == []
    with pytest.raises(FileNotFoundError):
        read_rows(tmp_path / f"none.{ending}")


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    target = write_rows(HARD, tmp_path / "rows.csv")
    before = target.read_bytes()
    with pytest.raises(ValueError, match="not in fieldnames"):
        write_rows([row(), row(surprise=1)], target)
    with pytest.raises(KeyboardInterrupt), replaced(target) as temporary:
        temporary.write_text("half a")
        raise KeyboardInterrupt
    assert target.read_bytes() == before and list(tmp_path.iterdir()) == [target]


def test_other_endings_and_parquet_without_pyarrow_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse(r"rows\.txt: rows are written to \.csv or \.parquet", write_rows, [], tmp_path / "rows.txt")
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # importing it now fails
    refuse(r"unlike \.csv, needs pyarrow: .*bufgym\[bench\]", write_rows, HARD, tmp_path / "rows.parquet")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("cells", "change", "message"),
    [
        ({"qoi": "many"}, str, "qoi = 'many': must be a number"),
        ({"seed": "1.5"}, str, "seed = '1.5': must be a number"),
        ({"certified": "yes"}, str, "certified = 'yes': must be True or False"),
        ({}, lambda line: line.rsplit(",", 1)[0], f"must have {len(RUNS)} cells, as line 1 has"),
        ({}, lambda line: f"{line},7", f"must have {len(RUNS)} cells, as line 1 has"),
    ],
)
def test_a_broken_line_is_named(tmp_path: Path, cells: Row, change: Any, message: str) -> None:
    """The third row of a file whose first row's label spans two lines: line 1 + 2 + 1 + 1 = 5."""
    path = write_rows([row(scenario="two\nlines"), row(), row(**cells)], tmp_path / "rows.csv")
    *rest, last = path.read_text().splitlines()
    path.write_text("\n".join([*rest, change(last)]) + "\n")
    with pytest.raises(BufgymError) as caught:
        read_rows(path)
    assert str(caught.value).startswith(f"{path}, line 5: {message}")


@pytest.mark.parametrize(
    "content", [b"policy,qoi\nafr,\xff\xfe\n", b'policy,qoi\n"afr"x,1\n', b'policy,qoi\n"afr,1\n', 0, 0.3, 0.9]
)
def test_a_file_that_is_none_or_cut_short_is_named(tmp_path: Path, content: bytes | float) -> None:
    """As CSV, or so much of a Parquet file."""
    path = tmp_path / "rows.csv"
    if not isinstance(content, bytes):
        pytest.importorskip("pyarrow", reason=needs("extras", "pyarrow"))
        path = write_rows(HARD, tmp_path / "rows.parquet")
        content = path.read_bytes()[: round(content * path.stat().st_size)]
    path.write_bytes(content)
    refuse(rf"{path.name}: no rows that can be read", read_rows, path)


def test_one_wrong_bit_in_a_parquet_page_is_noticed(tmp_path: Path) -> None:
    """Or else a number would be another and nobody the wiser. (Some bits say nothing that is needed.)"""
    pytest.importorskip("pyarrow", reason=needs("extras", "pyarrow"))
    rows = [row(qoi=1234.5678 + k, mean_age_s=1 / (k + 1)) for k in range(50)]
    path = write_rows(rows, tmp_path / "rows.parquet")
    right, content = repr(rows), path.read_bytes()
    noticed = 0
    for place in range(4, len(content) // 3, 101):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        try:
            assert repr(read_rows(path)) == right, place
        except BufgymError:
            noticed += 1
    assert noticed > 10

"""What the AFR paper states, against the simulator: Fig. 4 step by step, Fig. 5, Theorems 1-3, Eq. 9."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from cli_cases import Capsys, Patch
from hypothesis import given
from hypothesis import strategies as st
from refusal_cases import refuse

from bufgym import policies
from bufgym.cli import main
from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym.oracle import interruption as oracle
from bufgym.scenario import Interruption
from bufgym.traces import Trace, write_csv
from bufgym_papers.figures import NEEDS_DATA, afr_fig4, afr_fig5, afr_fig9, afr_theorems, figure, run

# Typed from the paper's figure: (T, dropped, r, c, p) with L = 8, the state after the decision. At T = 16 the pass is
# over and r doubles; 17 is rejected by the counter.
FIG4 = [(8, None, 1, 0, 0), *((8 + p, 2 * p - 1, 1, 0, p) for p in range(1, 8)), (16, 15, 2, 0, 0), (17, 17, 2, 1, 0)]
FIG4 += [(18, 2, 2, 0, 1)]


@pytest.mark.kernels
def test_fig4_step_by_step() -> None:
    """The steps come from one long run watched from inside; a run that ends at T delivers the same messages."""
    steps = afr_fig4.steps(8, 18, "afr-paper")
    assert [(s.T, s.dropped, s.r, s.c, s.p) for s in steps[7:]] == FIG4
    for step in steps:
        (gaps,) = afr_theorems.gaps_of("afr-paper", 8, [step.T])
        assert tuple(np.cumsum(gaps)[:-1]) == step.kept


def gained(T: int) -> tuple[float, float]:
    """H - 1 of AFR and of oracle-ideal, L = 8, V(d) = 1 - 0.618^d."""
    v = qoi.exponential(0.618)
    (ours,) = afr_fig5.gained("afr", [Interruption(law="fixed", t_max=T, value=v).episode(T)], 8, v)
    return float(ours), oracle.ideal(8, T, v)


def test_fig5_afr_equals_the_ideal_where_its_gaps_are_equal_and_is_below_it_one_message_later() -> None:
    for T in (17, 35, 71):
        ours, ideal = gained(T)
        assert ours == pytest.approx(ideal, rel=1e-13)
        assert ours == pytest.approx(9 * (1 - 0.618 ** ((T + 1) // 9)), rel=1e-13)  # by hand: 9 gaps of (T + 1) / 9
        later, ideal = gained(T + 1)
        assert later < 0.97 * ideal and (T < 35 or later < ours)  # information is not monotone in T
        assert T != 35 or (ours, later) == pytest.approx((7.687, 7.340), abs=5e-4)
    assert afr_fig5.mean_score("afr", 8, 9, 399) == pytest.approx(0.98598, abs=5e-6)
    assert afr_fig5.mean_score("drop-oldest", 8, 9, 399) == pytest.approx(0.47050, abs=5e-6)


def table(slopes: list[int]) -> Value:
    """Concave, non-decreasing, V(0) = 0, at most 1: slopes sorted from steep to flat, scaled to end at 1."""
    levels = np.append(0, np.cumsum(sorted(slopes, reverse=True)))
    return qoi.tabulated(range(len(levels)), (levels / levels[-1]).tolist())


TABLES = st.lists(st.integers(1, 1000), min_size=1, max_size=40).map(table)
VALUES = st.floats(0.05, 0.995).map(qoi.exponential) | st.floats(0.5, 200).map(qoi.saturating) | TABLES


@given(L=st.integers(1, 40), T=st.integers(1, 500), v=VALUES)
def test_theorems_for_any_L_T_and_V(L: int, T: int, v: Value) -> None:
    (gaps,) = afr_theorems.gaps_of("afr", L, [T])
    assert gaps.sum() == T + 1 and len(gaps) == min(L, T) + 1
    afr = sum(v(float(g)) for g in gaps)
    integer, ideal = oracle.integer(L, T, v), oracle.ideal(L, T, v)
    # 1: the oracles bound AFR
    assert afr <= integer * (1 + 1e-12)
    assert integer <= ideal * (1 + 1e-12)
    # 2: the paper's bound, the sharper one, and the exact worst over every V
    assert afr_theorems.bound(L) == pytest.approx(2 * (math.sqrt(2) - 1) * L / (L + 1))
    assert afr_theorems.bound(L) < afr_theorems.sharper_bound(L) < 1
    worst = afr_theorems.worst_ratio(gaps)
    assert afr / ideal >= worst - 1e-9
    assert worst >= afr_theorems.sharper_bound(L) - 1e-12
    # 3: gaps of r and 2r, and a shorter one at the edge
    assert afr_theorems.even_enough(gaps)
    doublings = math.log2((T + 1) / (L + 1))
    if doublings >= 0 and doublings == int(doublings):
        assert set(gaps) == {2 ** int(doublings)}
    assert set(gaps[:-1]) <= {min(gaps[:-1]), 2 * min(gaps[:-1])}
    # V at whole numbers is sum of w_D min(d, D), w_D = the fall of V's slope at D, and H is linear in V.
    slopes = np.diff([v(float(d)) for d in range(T + 3)])
    weights = slopes[:-1] - slopes[1:]
    weights[-1] = slopes[-2]  # beyond the longest gap V need not go on
    assert weights @ afr_theorems.extremes(gaps) == pytest.approx(afr, rel=1e-9)


def test_theorems_can_fail() -> None:
    """Drop Oldest is below AFR for some V at every T beyond L: it leaves one gap of T - L + 1, far above the others."""
    for L, T in ((3, 9), (8, 30)):
        (afr,), (oldest,) = (afr_theorems.gaps_of(policy, L, [T]) for policy in ("afr", "drop-oldest"))
        assert (afr_theorems.extremes(oldest) < afr_theorems.extremes(afr)).any()
        assert not afr_theorems.even_enough(oldest)
        assert afr_theorems.worst_ratio(oldest) < afr_theorems.bound(L)


@pytest.mark.parametrize("name", ["afr", "drop-oldest", "random", "orbbuf"])
def test_the_timed_loop_makes_the_policys_own_decisions(name: str) -> None:
    policy = policies.get(name)
    buffer, arrivals = afr_fig9.full_queue(8, 30)
    assert buffer.slots["seq"].tolist() == list(range(1, 9))
    assert arrivals["seq"].tolist() == list(range(9, 39))
    start, memory = policy.new_memory(2)
    looped = afr_fig9.decide_often(buffer, arrivals, memory, start, policy.compiled[0], 2)
    memory = policy.new_memory()[0]
    assert looped == 2 * sum(policy.compiled[0](buffer, arrivals[k], memory) for k in range(30))


# Fig. 6 of the AFR paper: facts of the recorded link, and recordings that are missing.


def test_fig6_names_the_seconds_under_500_KB_per_s(tmp_path: Path) -> None:
    path = tmp_path / "dips.csv"
    write_csv(Trace.steps([(1, 9e6), (1, 0.4e6), (1, 9e6), (1, 0.5e6), (1, 0.1e6)], name="dips"), path)
    # 90 frames: seconds 0, 1, 2. 500 KB/s itself is not under 500 KB/s.
    fig6 = figure("afr-fig6", trace=str(path), frames=90, size_bytes=200_000)
    rows = fig6.simulate()
    assert rows.where(under_500KBps=True).distinct("second") == [1, 4]
    assert rows.where(streamed=True).distinct("second") == [0, 1, 2]
    facts = fig6.claims(rows)
    assert not facts["low-seconds"] and facts["low_seconds"] == "1"
    assert fig6.tables(rows) == ["Second 1: 400.0 KB/s, from 1.00 to 2.00 s of the trace."]
    assert (facts["under"], facts["seconds"], facts["overload"]) == (1, 3, False)  # under the demand of 6 MB/s
    assert facts["carried"] == pytest.approx(18.4 / 18)


def test_recordings_that_are_missing_are_named(tmp_path: Path) -> None:
    for name in NEEDS_DATA:
        refuse(r"\(--data DIR\) with belgium_4g/csv/report_car_0002.csv", run, name)
        refuse(r"report_car_0002.csv: no such file", run, name, data=tmp_path)


def test_all_leaves_them_out_without_data(tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    data, out = tmp_path / "data", str(tmp_path / "out")
    (data / "belgium_4g" / "csv").mkdir(parents=True)
    trace = Trace.steps([(1, 9e6), (40, 0.4e6)], name="report_car_0002")
    write_csv(trace, data / "belgium_4g" / "csv" / "report_car_0002.csv")
    monkeypatch.setattr("bufgym_papers.figures.FIGURES", {"afr-fig6": "needs data"})
    for words, code, says in (
        (["all"], 0, "afr-fig6: left out; it needs a folder of recordings (--data DIR) with belgium_4g/csv/"),
        (["afr-fig6"], 2, "(--data DIR)"),
        (["all", "--data", str(tmp_path / "absent")], 2, "no such folder (--data)"),
        (["afr-fig6", "--data", str(data)], 0, "The link is report_car_0002"),
    ):
        assert main(["reproduce", *words, "--out", out]) == code
        assert says in "".join(capsys.readouterr())
    with (tmp_path / "out" / "afr-fig6.csv").open(newline="") as file:
        assert [row["under_500KBps"] for row in csv.DictReader(file)][:2] == ["False", "True"]

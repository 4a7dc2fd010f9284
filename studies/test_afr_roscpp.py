"""The camera in C++ under policies: claims by hand, and a short run where there are roscpp and root."""

from pathlib import Path

import pytest
from needs import needs

from bufgym.utils.errors import BufgymError
from bufgym_papers.figures import figure, run
from bufgym_papers.figures.rows import FigureRows
from studies import afr_roscpp


def row(rtt_ms: float, policy: str, qoi: float, gap: int, differ: int | None = 0, us: float = 4.0) -> dict[str, object]:
    return {"rtt_ms": rtt_ms, "policy": policy, "qoi": qoi, "longest_gap": gap, "differ": differ, "decision_us": us}


ROWS = [
    row(0.0, "stock", 98.0, 43, None, float("nan")),
    row(0.0, "stock", 102.0, 50, None, float("nan")),
    row(0.0, "afr", 108.0, 17),
    row(0.0, "learned", 111.0, 14),
    row(50.0, "stock", 100.0, 101, None, float("nan")),
    row(50.0, "afr", 115.0, 16),
    row(50.0, "learned", 130.0, 13, us=9.9),
]


def test_the_claims_by_hand() -> None:
    """Each holds at its limit, and one number beyond it turns its claim alone."""
    study = figure("afr-roscpp", policies=("stock", "afr", "learned"))
    held = {"more": True, "gaps": True, "same": True, "soon": True}
    found = study.claims(FigureRows(ROWS))
    assert {claim: found[claim] for claim in held} == held
    assert found["ratios"] == "afr 1.080 at 0 ms, learned 1.110 at 0 ms, afr 1.150 at 50 ms, learned 1.300 at 50 ms"
    beyond = {"more": {"qoi": 107.0}, "gaps": {"longest_gap": 18}, "same": {"differ": 1}, "soon": {"decision_us": 10.1}}
    for claim, worse in beyond.items():
        found = study.claims(FigureRows([*ROWS[:2], {**ROWS[2], **worse}, *ROWS[3:]]))
        assert {claim: found[claim] for claim in held} == {**held, claim: False}


def test_without_roscpp_or_root_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(afr_roscpp, "impossible", lambda: "no libroscpp-dev here")
    with pytest.raises(BufgymError, match="afr-roscpp: no libroscpp-dev here"):
        run("afr-roscpp")


@pytest.mark.nightly
def test_a_short_run(tmp_path: Path) -> None:
    if reason := afr_roscpp.impossible():
        pytest.skip(needs("root" if "root" in reason or "/dev" in reason else "roscpp", reason))
    text = run("afr-roscpp", tmp_path, policies=("stock", "afr"), seconds=2.0, stock_runs=1)
    assert "holds. 0 decisions differ" in " ".join(text.split())
    assert (tmp_path / "afr-roscpp.csv").exists()

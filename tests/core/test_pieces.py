"""Long episodes in pieces: a bound that no plan beats, whatever the pieces; and plans that are kept on disk."""

import sys
from typing import Any

import numpy as np
import pytest
from cases import trace

from bufgym import policies, scenario
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.oracle import clairvoyant, kept, pieces
from bufgym.oracle.clairvoyant import Plan
from bufgym.scenario import Episode, messages
from bufgym.scenario.numbered import draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome

PLANNER = sys.modules[clairvoyant.__module__]


def in_pieces(patch: Any, length: int, margin: int, episode: Episode, L: int, v: qoi.Value, **limits: int) -> Plan:
    """The plan of an episode that counts as long, in pieces of so many messages; nothing is read from disk."""
    patch.setattr(PLANNER, "LONG", 1)
    patch.setattr(PLANNER, "kept", lambda inputs, messages, find: find())
    patch.setattr(pieces, "PIECE", length)
    patch.setattr(pieces, "MARGIN", margin)
    return clairvoyant(episode, L, v, **limits)


@pytest.mark.kernels
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(("length", "margin"), [(7, 0), (50, 40)])
def test_pieces_bound_what_is_exact_in_one(monkeypatch, seed, length, margin):
    """Messages of ten bytes, links that rest, scenes that stand: the exact optimum lies below the bound, and the plan,
    which keeps to its room, below the optimum."""
    rng = np.random.default_rng(seed)
    n, L = int(rng.integers(60, 120)), int(rng.integers(1, 6))
    us, x = np.cumsum(rng.choice([0, 3, 9, 20, 200], n)), np.cumsum(rng.choice([0, 0.25, 1, 2.5], n))
    knots = [(0, 0), (400, int(rng.integers(1, 5)) * 100), (500 + 300 * (seed % 2), 500), (1_400, 900)]
    episode = Episode(messages(us, np.array(10), x), Link(trace(knots, ("loop", "hold", "stop")[seed % 3])))
    v = (qoi.exponential(0.4), qoi.saturating(2.5))[seed % 2]
    exact = clairvoyant(episode, L, v)
    plan = in_pieces(monkeypatch, length, margin, episode, L, v)
    assert exact.certified and exact.qoi <= plan.qoi + 1e-9
    monkeypatch.setattr(PLANNER, "clairvoyant", lambda *_, **__: plan)
    result = outcome(run(policies.get("clairvoyant"), [episode], L, v), 0)
    assert result.invalid == 0 and result.delivered == plan.kept.sum()
    assert 0.8 * exact.qoi <= result.qoi <= exact.qoi + 1e-9
    if plan.certified:
        assert plan.qoi == pytest.approx(exact.qoi, abs=1e-8)


def test_a_margin_brings_the_bound_close(monkeypatch):
    """Two minutes of a fading link: in one piece the bound is within a thousandth of the optimum, in twelve of ten
    seconds each within a hundredth."""
    lte = scenario.get("lte", duration_s=120.0)
    episode = draw(lte, 0)
    exact = clairvoyant(episode, 8, lte.value).qoi
    for length, close in ((4_000, 1.001), (300, 1.01)):
        bound = in_pieces(monkeypatch, length, 500, episode, 8, lte.value).qoi
        assert exact <= bound <= close * exact


def test_unequal_sizes_in_pieces_keep_to_messages_and_bytes(monkeypatch):
    lte = scenario.get("lte", duration_s=30.0, size_cv=0.5)
    episode, limits = draw(lte, 1), {"max_bytes": 1_500_000}
    plan = in_pieces(monkeypatch, 200, 100, episode, 5, lte.value, **limits)
    monkeypatch.setattr(PLANNER, "clairvoyant", lambda *_, **__: plan)
    result = outcome(run(policies.get("clairvoyant"), [episode], 5, lte.value, **limits), 0)
    afr = outcome(run(policies.get("afr"), [episode], 5, lte.value, **limits), 0)
    assert result.invalid == 0 and result.delivered == plan.kept.sum()
    assert afr.qoi <= result.qoi <= plan.qoi + 1e-9 < 1.3 * result.qoi


def test_a_kept_plan_is_read_and_a_damaged_one_made_anew(monkeypatch, tmp_path):
    monkeypatch.setattr(kept, "FOLDER", str(tmp_path / "kernels"))
    found, made = (2.1, np.array([True, False, True] * 3), True), list[int]()

    def find() -> kept.Found:
        made.append(1)
        return found

    def asked(*inputs: Any) -> int:
        qoi_, plan, certified = kept.kept(inputs, 9, find)
        assert (qoi_, plan.tolist(), certified) == (2.1, found[1].tolist(), True)
        return len(made)

    size = np.full(9, 10)
    assert [asked(size, 3), asked(size, 3)] == [1, 1]
    assert asked(size, 4) == 2  # another capacity
    assert asked(size + 1, 4) == 3
    for file in (tmp_path / "plans").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[:-1])
    assert [asked(size, 3), asked(size, 3)] == [4, 4]
    monkeypatch.setattr(kept, "sources", lambda: "another text")
    assert asked(size, 3) == 5

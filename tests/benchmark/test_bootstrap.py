"""Links drawn jointly, the share of AFR's regret and its paired difference, by hand."""

import numpy as np
import pytest
from refusal_cases import refuse
from test_score import TWO_CELLS, cell_of, noisy, rows_of, standing_of, width

from bufgym.benchmark import score
from bufgym.benchmark.bootstrap import links_drawn, percentile_interval, stream, times_drawn


def test_links_are_drawn_jointly_by_hand() -> None:
    """Two scenarios over the links a and b, two seeds each; all is won on a and nothing on b.

    A draw of two links is aa, ab, ba or bb, so jointly the mean of the two scores is 1, 1/2, 1/2 or 0: 0 and 1 have 1/4
    each, and the central 80 % are [0, 1]. Drawn apart, 0 and 1 have 1/16 each, 1/4 and 3/4 have 1/4: [1/4, 3/4].
    """
    met = [("a", 0), ("a", 1), ("b", 0), ("b", 1)]
    won = np.array([1.0, 1.0, 0.0, 0.0])
    drawn = links_drawn({"time": met, "motion": met, "reverse": met[::-1]})
    assert drawn["time"].shape == (2001, 4) and (drawn["time"][0] == 1).all()
    assert (drawn["time"][:, 0] == drawn["time"][:, 1]).all() and (drawn["time"].sum(axis=1) == 4).all()
    assert (drawn["time"] == drawn["motion"]).all() and (drawn["time"] == drawn["reverse"][:, ::-1]).all()
    assert percentile_interval((drawn["time"] @ won + drawn["motion"] @ won) / 8, 0.8) == (0.5, 0, 1)
    apart = sum(times_drawn(2, 2000, stream(0, name))[:, 0] / 4 for name in ("time", "motion"))
    assert percentile_interval(np.asarray(apart), 0.8) == (0.5, 0.25, 0.75)
    h = {"drop-oldest": [0] * 4, "mine": 10 * won}
    rows = [row for s in ("time", "motion") for row in rows_of(h, [10] * 4, traces=["a", "a", "b", "b"], scenario=s)]
    made = score.scores(rows)
    assert standing_of(made, "mine")["score"] == (0.5, 0, 1)
    assert cell_of(made, "mine", "time").qoi == (5, 0, 10)


def test_on_one_link_episodes_are_drawn() -> None:
    drawn = links_drawn({"one": [("a", 0), ("a", 1), ("a", 2)]}, resamples=500)["one"]
    assert (drawn.sum(axis=1) == 3).all() and set(drawn[1:].ravel()) == {0, 1, 2, 3}


def test_a_link_with_more_seeds_weighs_more() -> None:
    """Link a has three episodes with H 2 and b one with 6: the mean is 3, on aa it is 2 and on bb 6."""
    rows = rows_of({"drop-oldest": [2, 2, 2, 6]}, [8] * 4, traces=["a", "a", "a", "b"])
    assert cell_of(score.scores(rows), "drop-oldest").qoi == (3, 2, 6)


def test_share_of_afrs_regret_and_its_paired_difference_by_hand() -> None:
    """Regrets at L = 4 and L = 2: afr 4/38 and 8/20, mine 3/38 and 6/20, drop-oldest 8/38 and 10/20."""
    made = score.scores(TWO_CELLS, against="mine")
    afr, mine, oldest = (a / 38 + b / 20 for a, b in ((4, 8), (3, 6), (8, 10)))
    assert standing_of(made, "mine")["share"].value == pytest.approx(mine / afr) == pytest.approx(0.75)
    assert standing_of(made, "drop-oldest")["share"].value == pytest.approx(oldest / afr)
    assert standing_of(made, "afr")["share"] == (1, 1, 1) and standing_of(made, "mine")["against"] == (0, 0, 0)
    less = standing_of(made, "drop-oldest")["against"]
    assert less.value == pytest.approx((oldest - mine) / afr) and less.low <= less.value <= less.high
    plain = score.scores(TWO_CELLS)
    assert "against" not in standing_of(plain, "mine").values and plain.cells == made.cells
    refuse("no row of min-gap, with which the others are to be compared", score.scores, TWO_CELLS, against="min-gap")


def test_a_difference_is_paired() -> None:
    """What is common to two policies moves both shares and not their difference."""
    cell = noisy(60)
    h = cell["h"]
    h |= {"mine": h["afr"] + 0.2, "other": h["afr"] + 0.25}
    mine = standing_of(score.scores(rows_of(**cell), against="other"), "mine")
    assert mine["against"].low > 0 and width(mine["against"]) < 0.5 * width(mine["share"])
    alone = score.scores(rows_of(h={"drop-oldest": h["drop-oldest"], "mine": h["mine"]}, best=cell["best"]))
    assert np.isnan(standing_of(alone, "mine")["share"]).all()

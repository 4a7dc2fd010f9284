"""Bootstrap intervals by hand: over links, over links and trainings, within their range, and where they cannot hold."""

import numpy as np
import pytest
import scipy.stats
from test_score import cell_of, rows_of, standing_of

from bufgym.benchmark.bootstrap import (
    carriers,
    interval,
    links_drawn,
    links_in,
    remark,
    stream,
    students_t,
    times_drawn,
    together,
)
from bufgym.benchmark.score import scores
from bufgym.benchmark.tasks import TASKS


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
    jointly = (drawn["time"] @ won + drawn["motion"] @ won) / 8
    apart = sum(times_drawn(2, 2000, stream(0, name))[:, 0] / 4 for name in ("time", "motion"))
    assert np.quantile(jointly, [0.1, 0.9]).tolist() == [0, 1]
    assert np.quantile(apart, [0.1, 0.9]).tolist() == [0.25, 0.75]
    h = {"drop-oldest": [0] * 4, "mine": 10 * won}
    rows = [row for s in ("time", "motion") for row in rows_of(h, [10] * 4, traces=["a", "a", "b", "b"], scenario=s)]
    made = scores(rows)
    assert standing_of(made, "mine")["score"] == interval(jointly, 2, within=(-np.inf, 1))
    assert cell_of(made, "mine", "time").qoi == pytest.approx(interval(10 * jointly, 2, within=(0, np.inf)))


def test_an_interval_by_hand() -> None:
    """Nine links, of which resamples say -1 or 1 equally often, and the sample 0.

    The standard error is 1, times sqrt(9 / 8) for so few links. Student's t with 8 degrees of freedom is 2.306, so the
    interval reaches 2.446 to either side; percentiles of -1 and 1 reach 1. A probability ends at 0 and 1.
    """
    numbers = np.array([0.0] + [-1.0, 1.0] * 500)
    assert interval(numbers, 9) == pytest.approx((0, -2.446, 2.446), abs=1e-3)
    assert interval(numbers, 9, within=(0, 1)) == (0, 0, 1)
    # Where nearly all resamples agree and a few are far away, the percentiles reach further.
    skewed = np.array([0.0] + [0.0] * 98 + [10.0] * 2)
    assert interval(skewed, 9).high == 10 and interval(skewed, 9).low < 0
    # 1e-13 is a sum in another order, not a difference; one link says nothing about others.
    assert interval(np.full(9, 1e-13), 9) == (0, 0, 0)
    assert np.isnan(interval(numbers, 1)[1:]).all()


@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
def test_students_t_is_that_of_scipy(confidence: float) -> None:
    assert students_t(0.95, 3) == pytest.approx(3.182446305284263, rel=1e-10)  # Student's table has 3.182
    for freedom in [*range(1, 61), 399, 400, 10_001]:
        expected = scipy.stats.t.ppf((1 + confidence) / 2, freedom)
        assert students_t(confidence, freedom) == pytest.approx(expected, rel=1e-9)


def test_links_and_trainings_together_by_hand() -> None:
    """Nine links reach 2.446 to either side, as above; four trainings sqrt(4 / 3) x 3.182 = 3.675: together 4.414."""
    moving = np.array([0.0] + [-1.0, 1.0] * 500)
    assert together([(moving, 9), (moving, 4)]) == pytest.approx((0, -4.414, 4.414), abs=1e-3)
    assert together([(moving, 9), (moving, 4)], within=(-1, 1)) == (0, -1, 1)
    # What a statistic does not depend on adds nothing, and no level is left out for being unknown.
    assert together([(moving, 9), (moving[:1], 4), (np.zeros(9), 4)]) == interval(moving, 9)
    assert np.isnan(together([(moving, 1), (moving, 4)])[1:]).all()
    # The reaches to the two sides are joined apart: where links have a long tail upwards, so has the whole.
    skewed = np.array([0.0] + [0.0] * 98 + [10.0] * 2)
    both, alone = together([(skewed, 9), (moving, 4)]), interval(skewed, 9)
    assert both.high == pytest.approx(np.hypot(alone.high, 3.675), abs=1e-3) and both.high > -both.low


def test_no_bound_leaves_its_range() -> None:
    """Robots above: of 4 episodes, 3 have all robots above and one none, so 75 %, where t alone would reach 155 %."""
    numbers = links_drawn({"one": [("a", k) for k in range(4)]})["one"] @ np.array([1.0, 1, 1, 0]) / 4
    assert interval(numbers, 4).high > 1.5
    assert interval(numbers, 4, within=(0, 1)) == (0.75, 0, 1)
    # Rounding may put the number itself outside; its interval still has it.
    assert interval(np.full(9, 1 + 1e-9), 9, within=(0, 1)) == pytest.approx((1, 1, 1), abs=1e-8)


def test_a_remark_where_few_links_carry_half_of_the_loss() -> None:
    """Of six links one loses 10 of 15; of eight two lose 4 + 4 of 14. Two of six, or of four equal ones, are many."""
    assert [carriers(np.array(losses)) for losses in ([10.0, 1, 1, 1, 1, 1], [4.0, 4, 1, 1, 1, 1], [1.0] * 6)] == [
        1,
        2,
        3,
    ]
    (one,) = remark(np.array([10.0, 1, 1, 1, 1, 1]), "afr", "links")
    assert one.startswith("note: 1 of 6 links carries half of what afr loses: ")
    assert "2 of 8 episodes carry half" in remark(np.array([4.0, 4, 1, 1, 1, 1, 1, 1]), "afr", "episodes")[0]
    for usual in ([4.0, 4, 1, 1, 1, 1], [1.0] * 6, [2.0, 1, 0], [1.0] * 4):
        assert remark(np.array(usual), "afr", "links") == []
    best = [20.0] * 6
    uneven = {"drop-oldest": [10.0] * 6, "afr": [10.0, 19, 19, 19, 19, 19]}
    rows = rows_of(uneven, best, traces=list("abcdef"))
    task = TASKS["queue"]
    assert task.summary(rows).notes == (one,) and task.summary(rows_of({**uneven, "afr": [18] * 6}, best)).notes == ()


def test_links_are_counted_where_there_are_fewest() -> None:
    """One trace with three seeds: the episodes are drawn. Two traces with five episodes: two links."""
    one, two = [("a", 0), ("a", 1), ("a", 2)], [("a", 0), ("a", 1), ("b", 0), ("b", 1), ("b", 2)]
    assert links_in({"one": one}) == 3 and links_in({"one": one, "two": two}) == 2 and links_in({}) == 0


def test_on_one_link_episodes_are_drawn() -> None:
    drawn = links_drawn({"one": [("a", 0), ("a", 1), ("a", 2)]})["one"]
    assert (drawn.sum(axis=1) == 3).all() and set(drawn[1:].ravel()) == {0, 1, 2, 3}


def test_a_link_with_more_seeds_weighs_more() -> None:
    """Link a has three episodes with H 2 and b one with 6: the mean is 3, on aa it is 2 and on bb 6."""
    rows = rows_of({"drop-oldest": [2, 2, 2, 6]}, [8] * 4, traces=["a", "a", "a", "b"])
    low, high = cell_of(scores(rows), "drop-oldest").qoi[1:]
    drawn = links_drawn({"one": [("a", 0), ("a", 1), ("a", 2), ("b", 0)]})["one"]
    means = drawn @ np.array([2.0, 2, 2, 6]) / drawn.sum(axis=1)
    assert set(means) == {2, 3, 6}
    assert (low, high) == interval(means, 2, within=(0, np.inf))[1:] and low == 0 and high > 6  # H is never below 0

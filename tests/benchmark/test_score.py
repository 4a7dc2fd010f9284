"""The scores of one queue and the table, by hand: interquartile mean, improvement, paired bootstrap intervals."""

import math
import random
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from refusal_cases import refuse

from bufgym.benchmark import score, table
from bufgym.benchmark.score import CellScore, Interval, Scores, Standing
from bufgym.benchmark.tasks import QueueTask


def rows_of(
    h: Mapping[str, Sequence[float]], best: Sequence[float | None], *, traces: Sequence[str] = (), **more: Any
) -> list[dict[str, Any]]:
    """One cell: H by policy and episode, clairvoyant H by episode; seeds count up within one trace unless named."""
    cell = {"scenario": "lte", "capacity": 4, "certified": True, **more}
    return [
        {**cell, "trace": traces[i] if traces else "t", "seed": i, "policy": name, "qoi": qoi, "clairvoyant": best[i]}
        for name, values in h.items()
        for i, qoi in enumerate(values)
    ]


def cell_of(made: Scores, policy: str, scenario: str = "lte", capacity: int = 4) -> CellScore:
    (found,) = (c for c in made.cells if (c.policy, c.scenario, c.capacity) == (policy, scenario, capacity))
    return found


def standing_of(made: Scores, policy: str) -> Standing:
    (found,) = (s for s in made.standings if s.policy == policy)
    return found


def interquartile_mean(x: Sequence[float]) -> float:
    """The mean without the quarter of the numbers at either end, rounded down."""
    cut = len(x) // 4
    return float(np.sort(x)[cut : len(x) - cut].mean())


def width(interval: Interval) -> float:
    return interval.high - interval.low


TWO_CELLS = [
    *rows_of({"drop-oldest": [10, 20], "afr": [12, 22], "mine": [14, 21]}, [14, 24]),
    *rows_of({"drop-oldest": [5, 5], "afr": [6, 6], "mine": [6, 8]}, [10, 10], capacity=2),
]
"""Sums at L = 4: 30, 34, 35, clairvoyant 38. At L = 2: 10, 12, 14, clairvoyant 20."""


def test_scores_by_hand() -> None:
    made = score.scores(TWO_CELLS)
    # L = 4: (35 - 30) / (38 - 30) and 1 - 35 / 38; L = 2: (14 - 10) / (20 - 10) and 1 - 14 / 20.
    mine = cell_of(made, "mine")
    assert mine.score.value == pytest.approx(5 / 8) and mine.regret.value == pytest.approx(3 / 38)
    assert mine.qoi.value == pytest.approx(17.5)
    assert mine.difference.value == pytest.approx(0.5)  # (2 - 1) / 2
    assert (mine.episodes, mine.discriminative, mine.exact) == (2, True, True)
    assert cell_of(made, "mine", capacity=2).score.value == pytest.approx(0.4)
    overall = standing_of(made, "mine")
    assert overall["score"].value == pytest.approx((5 / 8 + 4 / 10) / 2)
    assert overall["regret"].value == pytest.approx((3 / 38 + 6 / 20) / 2)
    # L = 4: one better, one worse; L = 2: one equal, one better.
    assert overall["improvement"].value == pytest.approx((1 / 2 + 3 / 4) / 2) and made.counted == 2
    assert [(s.policy, s.ranked) for s in made.standings] == [("mine", True), ("afr", True), ("drop-oldest", True)]
    order = [(2, "afr"), (2, "drop-oldest"), (2, "mine"), (4, "afr")]
    assert [(c.capacity, c.policy) for c in made.cells[:4]] == order


def test_the_scale_is_fixed_at_both_ends_and_open_beyond() -> None:
    """Whatever is drawn: Drop Oldest scores 0, the clairvoyant 1, and an unbounded queue may pass it."""
    best = [14, 24, 9]
    h = {"drop-oldest": [10, 20, 7], "clairvoyant": best, "rosbridge": [16, 26, 11]}
    made = score.scores(rows_of(h, best), unranked=dict.fromkeys(["clairvoyant", "rosbridge", "not there"], "why"))
    assert standing_of(made, "drop-oldest")["score"] == (0, 0, 0)
    assert standing_of(made, "clairvoyant")["score"] == pytest.approx((1, 1, 1))
    assert standing_of(made, "clairvoyant")["regret"] == pytest.approx((0, 0, 0))
    assert standing_of(made, "rosbridge")["score"].value == pytest.approx(1.6)
    # Shown after those that are ranked, however good.
    order = [("drop-oldest", True), ("rosbridge", False), ("clairvoyant", False)]
    assert [(s.policy, s.ranked) for s in made.standings] == order


def test_a_cell_that_is_not_discriminative_is_shown_and_not_scored() -> None:
    """At L = 9 Drop Oldest's regret is 1 / 200 < 1 %; at L = 8 it is 2 / 200."""
    quiet = rows_of({"drop-oldest": [99.5, 99.5], "afr": [99, 99], "mine": [9, 9]}, [100, 100], capacity=9)
    made = score.scores([*TWO_CELLS, *quiet])
    assert not cell_of(made, "mine", capacity=9).discriminative
    assert cell_of(made, "mine", capacity=9).score.value == pytest.approx(-181)
    assert made.standings == score.scores(TWO_CELLS).standings
    edge = rows_of({"drop-oldest": [99, 99], "afr": [99, 99], "mine": [99, 100]}, [100, 100], capacity=8)
    made = score.scores([*TWO_CELLS, *edge])
    assert cell_of(made, "afr", capacity=8).discriminative
    assert made.counted == 3


@pytest.mark.parametrize("best", [[None, None], [14, None], [10, 20]])
def test_without_a_discriminative_cell_there_are_no_standings(best: list[float | None]) -> None:
    """No clairvoyant at all, one missing episode of it, or Drop Oldest as good as the clairvoyant."""
    made = score.scores(rows_of({"drop-oldest": [10, 20], "afr": [10, 20]}, best))
    cell, overall = cell_of(made, "afr"), standing_of(made, "afr")
    assert not cell.discriminative and cell.qoi.value == 15 and made.counted == 0
    assert np.isnan(cell.score).all() and np.isnan(cell.regret).all() == (None in best)
    assert all(np.isnan(overall[name]).all() for name in ("score", "iqm", "regret", "improvement"))


@pytest.mark.parametrize(
    ("values", "mean"),
    [
        ([100, 2, 3, -50], 2.5),
        ([1, 2, 6], 3),  # floor(3 / 4) = 0 are cut
        ([9, 1, 2, 3, 4, 5, 0], 3),  # 1 is cut at either end
        ([100, 2, math.nan, 3, -50], 2.5),
        ([math.nan], math.nan),
    ],
)
def test_interquartile_mean_by_hand(values: list[float], mean: float) -> None:
    """Scores of one trace each, as Drop Oldest has 0 and the clairvoyant 1; where both have 1 there is none."""
    same = [float(math.isnan(value)) for value in values]
    h = {"drop-oldest": same, "mine": [1.0 if math.isnan(value) else value for value in values]}
    made = score.scores(rows_of(h, [1.0] * len(values), traces=[f"t{k}" for k in range(len(values))]))
    assert standing_of(made, "mine")["iqm"].value == pytest.approx(mean, nan_ok=True)


def test_the_interquartile_mean_of_traces_by_hand() -> None:
    """Base 0 and clairvoyant 10 an episode: scores of the traces a..d are 0.1, 0.2, 0.4 and 0.9, of e 0/0.

    c's two episodes count as one task: (3 + 5) / 20 = 0.4. The middle half: (0.2 + 0.4) / 2.
    """
    h = {"drop-oldest": [0, 0, 0, 0, 0, 7], "mine": [1, 2, 3, 5, 9, 7]}
    made = score.scores(rows_of(h, [10, 10, 10, 10, 10, 7], traces=["a", "b", "c", "c", "d", "e"]))
    assert standing_of(made, "mine")["iqm"].value == pytest.approx(0.3)
    assert standing_of(made, "mine")["score"].value == pytest.approx(20 / 50)


def test_a_resampled_trace_weighs_as_often_as_it_was_drawn() -> None:
    """One episode a trace: as wide as it is when traces are drawn one by one, computed the slow way."""
    rng = np.random.default_rng(1)
    h = rng.uniform(0, 10, 40)
    traces = [f"{i:02}" for i in range(40)]
    made = standing_of(score.scores(rows_of({"drop-oldest": [0] * 40, "mine": h}, [10] * 40, traces=traces)), "mine")
    naive = [interquartile_mean(rng.choice(h / 10, 40)) for _ in range(2000)]
    assert made["iqm"].value == pytest.approx(interquartile_mean(h / 10))
    assert (made["iqm"].low, made["iqm"].high) == pytest.approx(np.percentile(naive, [2.5, 97.5]), abs=0.02)


def test_episodes_that_are_all_alike_leave_no_doubt() -> None:
    """An improvement of equals but for rounding is a tie."""
    made = score.scores(rows_of({"drop-oldest": [5.0] * 9, "afr": [7.0] * 9}, [9.0] * 9))
    overall = standing_of(made, "afr")
    assert overall["score"] == overall["iqm"] == pytest.approx((0.5, 0.5, 0.5))
    assert overall["regret"] == pytest.approx((2 / 9, 2 / 9, 2 / 9))
    assert overall["improvement"] == (0.5, 0.5, 0.5) and cell_of(made, "afr").difference == (0, 0, 0)
    rows = rows_of({"drop-oldest": [0.1], "afr": [0.1 + 0.2], "mine": [0.3]}, [1])
    assert standing_of(score.scores(rows), "mine")["improvement"].value == 0.5


def noisy(n: int, seed: int = 0, shared: float = 5.0) -> dict[str, Any]:
    """The parts of a cell in which Drop Oldest has b, AFR about b + 1 and the clairvoyant b + 2 in every episode."""
    rng = np.random.default_rng(seed)
    b = rng.normal(20, shared, n)
    return {"h": {"drop-oldest": b, "afr": b + 1 + rng.normal(0, 0.5, n)}, "best": list(b + 2)}


def test_what_an_episode_is_worth_to_everybody_cancels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Adding a constant per episode to all policies moves neither differences nor improvements nor scores."""
    calm, wild = noisy(50, shared=0.0), noisy(50, shared=0.0)
    worth = np.random.default_rng(9).normal(0, 3, 50)
    wild["h"] = {policy: values + worth for policy, values in wild["h"].items()}
    wild["best"] = [b + w for b, w in zip(wild["best"], worth, strict=True)]
    monkeypatch.setattr(score, "REFERENCE", "drop-oldest")
    one, other = (score.scores(rows_of(**cell)) for cell in (calm, wild))
    assert cell_of(one, "afr").difference == pytest.approx(cell_of(other, "afr").difference)
    assert cell_of(one, "afr").score == pytest.approx(cell_of(other, "afr").score)
    assert standing_of(one, "afr")["improvement"] == standing_of(other, "afr")["improvement"]
    assert width(cell_of(other, "afr").qoi) > 3 * width(cell_of(one, "afr").qoi)  # means do move
    assert width(cell_of(other, "afr").difference) < 0.5 * width(cell_of(other, "afr").qoi)


def test_all_capacities_of_a_scenario_share_their_draws() -> None:
    """Two cells with the same H are one cell twice; episodes that have nothing in common vary less in the mean."""
    cell = noisy(600)
    once = standing_of(score.scores(rows_of(**cell)), "afr")["score"]
    twice = [*rows_of(**cell), *rows_of(**cell, capacity=8)]
    assert standing_of(score.scores(twice), "afr")["score"] == pytest.approx(once)
    same = [*rows_of(**cell), *rows_of(**cell, scenario="other")]
    assert standing_of(score.scores(same), "afr")["score"] == pytest.approx(once)
    two = [*rows_of(**cell), *rows_of(**noisy(600, seed=1), scenario="other")]
    assert width(standing_of(score.scores(two), "afr")["score"]) == pytest.approx(width(once) / math.sqrt(2), rel=0.15)


def test_neither_order_nor_company_matters(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [*rows_of(**noisy(20), traces=["b", "a"] * 10), *rows_of(**noisy(15, seed=1), scenario="wifi")]
    made = score.scores(rows)
    for k in range(3):
        assert score.scores(random.Random(k).sample(rows, len(rows))) == made
    third = [{**row, "policy": "third"} for row in rows if row["policy"] == "afr"]
    assert standing_of(score.scores([*third, *rows]), "afr") == standing_of(made, "afr")
    monkeypatch.setattr(score, "SEED", 1)
    assert score.scores(rows) != made


def test_training_seeds_widen_the_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    """Agents 1, 2, 3 that gain 0.5, 1 and 1.5 of 2: on average the same as one that always gains 1."""
    cell = noisy(100)
    b = cell["h"]["drop-oldest"]
    noise = cell["h"]["afr"] - b - 1
    rows = rows_of(**cell)
    rows += [r for k in (1, 2, 3) for r in rows_of({"agent": b + k / 2 + noise}, cell["best"], training_seed=k)]
    made = score.scores(rows)
    agent, afr = standing_of(made, "agent"), standing_of(made, "afr")
    assert agent["score"].value == pytest.approx(afr["score"].value)
    assert agent["improvement"].value == 0.5
    # 1/4, 1/2, 3/4 have a standard deviation of 1/4, so their mean .144; Student's t, 2 degrees of freedom, is 4.303.
    # The links' own reach, that of AFR, adds as a square. A score ends at 1.
    low = 0.5 - math.hypot(4.303 * 0.25 / math.sqrt(3), 0.5 - afr["score"].low)
    assert agent["score"][1:] == pytest.approx((low, 1), abs=0.02)
    assert width(agent["score"]) > 5 * width(afr["score"])
    assert width(agent["improvement"]) == 1
    # One training seed is nothing to draw from, and a policy's own rows are not touched by others'.
    single = [dict(row, training_seed=7) if row["policy"] == "afr" else row for row in rows_of(**cell)]
    assert standing_of(score.scores(single), "afr") == standing_of(score.scores(rows_of(**cell)), "afr") == afr
    # A difference to another policy is drawn by the same trainings: to itself it is 0.
    against = score.scores(rows, against="agent")
    assert standing_of(against, "agent")["against"] == (0, 0, 0)
    assert width(standing_of(against, "afr")["against"]) > 3 * width(standing_of(against, "afr")["score"])
    # As a reference, the agent is its own equal in every draw.
    monkeypatch.setattr(score, "REFERENCE", "agent")
    assert standing_of(score.scores(rows), "agent")["improvement"] == pytest.approx((0.5, 0.5, 0.5))


def test_without_a_reference_there_is_no_improvement() -> None:
    made, whole = score.scores([row for row in TWO_CELLS if row["policy"] != "afr"]), score.scores(TWO_CELLS)
    assert np.isnan(standing_of(made, "mine")["improvement"]).all() and np.isnan(cell_of(made, "mine").difference).all()
    assert standing_of(made, "mine")["score"] == standing_of(whole, "mine")["score"]
    # Rows that lack the clairvoyant alone still fit.
    rows = [dict(row, clairvoyant=None) if row["policy"] == "mine" else row for row in TWO_CELLS]
    assert score.scores(rows) == whole


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "no rows"),
        ([{"trace": "t", "seed": 0}], "rows[0]: no scenario"),
        ([*TWO_CELLS, {**TWO_CELLS[0], "qoi": None}], "rows[12]: no qoi"),
        ([*TWO_CELLS, TWO_CELLS[0]], "drop-oldest at lte, L = 4, trace t, seed 0: more than one row"),
        (TWO_CELLS[:6] + TWO_CELLS[8:], "lte, L = 2: no row of the baseline 'drop-oldest'"),
        (TWO_CELLS[:10], "mine at lte, L = 2, trace t, seed 0: no row"),
        (
            [*TWO_CELLS[:-1], {**TWO_CELLS[-1], "clairvoyant": 10.5}],
            "mine at lte, L = 2, trace t, seed 1: clairvoyant = 10.5, but 10.0 for drop-oldest",
        ),
    ],
)
def test_rows_that_do_not_fit_together(rows: list[dict[str, Any]], message: str) -> None:
    refuse(re.escape(message), score.scores, rows)


def row(policy: str, capacity: int, qoi: float, **more: Any) -> dict[str, Any]:
    rest = dict.fromkeys([column.key for column in table.COLUMNS], 1.0)
    return {**rest, "policy": policy, "capacity": capacity, "qoi": qoi, "regret": None, "invalid": 0, **more}


ROWS = [
    row("b", 5, 2.0, delivered=3, mean_sojourn_s=0.5),
    row("b", 5, 4.0, delivered=4, mean_sojourn_s=math.nan),
    row("a", 5, 6.0),
    row("a", 2, 1.0),
    row("c", 2, 1.0, invalid=3),
]


def test_means_leave_out_what_is_missing_and_come_best_first() -> None:
    entries = table.means(ROWS)
    found = [(e["capacity"], e["policy"], e["qoi"]) for e in entries]
    assert found == [(2, "a", 1.0), (2, "c", 1.0), (5, "a", 6.0), (5, "b", 3.0)]
    assert (entries[3]["delivered"], entries[3]["mean_sojourn_s"]) == (3.5, 0.5)
    assert math.isnan(entries[3]["regret"])


def scored(policy: str, seed: int, qoi: float, best: float = 9.0, **more: Any) -> dict[str, Any]:
    more = {"scenario": "s", "trace": "t", "seed": seed, "clairvoyant": best, "regret": 1 - qoi / best, **more}
    return row(policy, 8, qoi, **more)


BASE = [scored("drop-oldest", 0, 4.0, delivered=3), scored("drop-oldest", 1, 5.0, best=11.0)]
MINE = [scored("mine", 0, 6.0), scored("mine", 1, 7.0, best=11.0)]


def table_of(rows: list[Any], unranked: Any = table.NOBODY, hidden: str = "") -> str:
    task = QueueTask()
    return task.tables(rows, task.summary(rows, unranked), None, unranked, hidden)[0].plain()


def test_the_score_leads_and_is_computed_on_sums() -> None:
    """Drop Oldest has 4 + 5, the clairvoyant 9 + 11, mine 6 + 7: (13 - 9) / (20 - 9); an unbounded queue has none."""
    free = [scored("rosbridge", seed, 12.0, best=best, regret=None) for seed, best in ((0, 9.0), (1, 11.0))]
    cells = {cell.policy: cell.score.value for cell in score.scores([*BASE, *MINE, *free]).cells}
    assert cells["mine"] == 4 / 11 and cells["drop-oldest"] == 0 and math.isnan(cells["rosbridge"])
    made = table_of([*BASE, *MINE, *free], unranked={"rosbridge": "its queue is unbounded"})
    assert made.split("\n")[1].split()[:3] == ["mine", "8", "0.364"]
    assert "score" not in table.means_table(MINE).plain()
    hidden = table_of([*BASE, *MINE], hidden="drop-oldest")
    assert hidden.split("\n")[1].split()[2] == "0.364" and "\ndrop-oldest" not in hidden


def test_policies_that_no_row_tells_apart_are_one_line() -> None:
    rivals = [{**entry, "policy": name} for entry in BASE for name in ("ros-keep-last", "near")]
    rivals[-1] |= {"delivered": 2}
    rows = [*rivals, *BASE, *MINE]
    assert table.with_equal_rows(rows) == {"drop-oldest": ["ros-keep-last"]}
    lines = table.means_table(rows).plain().split("\n")
    assert [line.split()[0] for line in lines[1:4]] == ["mine", "drop-oldest", "near"]
    assert "ros-keep-last" in lines[4] and "| ros-keep-last |" not in table.means_table(rows).markdown()
    # One that does not compete is a line of its own, whatever its rows.
    unbounded = [{**entry, "policy": "rosbridge"} for entry in BASE]
    assert table.with_equal_rows([*BASE, *unbounded], ["rosbridge"]) == {}


def test_the_table_and_the_page_have_one_regret_and_its_interval_is_a_share() -> None:
    """Of H 9 and 1 where 10 and 2 are best, 2 of 12 are lost, and not the mean of 0.1 and 0.5."""
    rows = []
    for seed, (h, best) in enumerate([(9.0, 10.0), (1.0, 2.0), (10.0, 10.0)]):
        for policy, own in (("drop-oldest", h / 2), ("mine", h)):
            about = {"scenario": "s", "capacity": 4, "policy": policy, "seed": seed, "trace": "t", "qoi": own}
            rows.append({**about, "clairvoyant": best, "certified": True, "regret": 1 - own / best})
    table_has = {entry["policy"]: entry["regret"] for entry in table.means(rows)}
    assert table_has["mine"] == pytest.approx(2 / 22)
    for cell in score.scores(rows).cells:
        assert cell.regret.value == pytest.approx(table_has[cell.policy])
        assert 0 <= cell.regret.low <= cell.regret.value <= cell.regret.high <= 1

"""Coverage of intervals: at small sizes, and over a made-up pool of links whose regrets are skewed."""

import numpy as np
import pytest

from studies import coverage

PRODUCT = "bufgym's: the wider of widened and bootstrap's"


def made_up_pool() -> coverage.Numbers:
    """Sums of H of 400 links: drop-oldest, AFR, gap-price, min-motion-gap, clairvoyant; losses are log-normal."""
    rng = np.random.default_rng(0)
    loss = 10 * rng.lognormal(0, 0.4, 400)
    parts = [
        loss,
        loss * rng.uniform(0.5, 0.9, 400),
        loss * rng.uniform(0.2, 0.5, 400),
        loss * rng.uniform(0.2, 0.6, 400),
    ]
    return np.array([*(100 - np.array(parts)), np.full(400, 100.0)]).T


@pytest.mark.parametrize("links", [4, 8, 16])
def test_the_products_intervals_cover_where_percentiles_fall_short(links: int) -> None:
    found = coverage.coverage(made_up_pool(), links, 600, 400, np.random.default_rng(links))
    for statistic in coverage.STATISTICS:
        assert found[PRODUCT, statistic][0] >= 0.92  # 93 %, less the error of 600 samples
        assert found[PRODUCT, statistic][0] >= found["percentile", statistic][0]
    assert links > 8 or found["percentile", "score"][0] < 0.92


@pytest.mark.parametrize("seeds", [2, 5])
def test_intervals_over_trainings_cover_where_degrees_of_links_fall_short(seeds: int) -> None:
    rng = np.random.default_rng(seeds)
    found = coverage.coverage_of_trainings(made_up_pool(), 24, seeds, 0.1, 400, 200, rng)
    old, *_, ours = coverage.LEVELS
    for statistic in coverage.STATISTICS:
        assert found[ours, statistic][0] >= 0.92  # 93 %, less the error of 400 samples
        assert found[old, statistic][0] < (0.85 if seeds == 2 else found[ours, statistic][0])


def test_without_a_spread_between_trainings_links_alone_count() -> None:
    pool, rng = made_up_pool(), np.random.default_rng(0)
    found = coverage.trained(pool[:24], np.zeros(3), 50, rng)["score"]
    assert found.errors[1] == pytest.approx(0, abs=1e-12)
    assert coverage.of_levels(found) == pytest.approx(coverage.drawn_together(found))


def test_rare_links_carry_most_of_the_loss() -> None:
    """A policy loses half as much as Drop Oldest. On 12 of 100 links 100 times as much: 1,200 of 1,244 parts."""
    pool = np.array([[98.0, 99.0, 100.0]] * 100)
    rare = coverage.with_rare(pool, 0.12)
    loss = (rare[:, -1:] - rare) / 2
    assert loss[:12, 1].sum() == 1200 and loss[12:, 1].sum() == 44
    assert (coverage.with_rare(pool, 0) - pool == coverage.with_rare(pool, 0)[0, 0] - 98).all()


def test_it_prints_a_row_for_each_way(capsys: pytest.CaptureFixture[str]) -> None:
    coverage.page(links=(3,), repetitions=2, pool=3, seeds=1, duration_s=2.0, resamples=20)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + len(coverage.WAYS) and lines[2].startswith("| 3 | percentile |")
    coverage.page((3,), 2, 3, seeds=1, duration_s=2.0, resamples=20, training_seeds=(2,), between=(0.1,))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + len(coverage.LEVELS) and lines[2].startswith("| 3 | 2 | 0.1 | drawn together")

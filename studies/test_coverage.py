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


def test_it_prints_a_row_for_each_way(capsys: pytest.CaptureFixture[str]) -> None:
    coverage.page(links=(3,), repetitions=2, pool=3, seeds=1, duration_s=2.0, resamples=20)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + len(coverage.WAYS) and lines[2].startswith("| 3 | percentile |")

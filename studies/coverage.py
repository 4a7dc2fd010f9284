"""How often 95 % intervals cover: the table of docs/guide/suites.md, "Intervals and shares".

python -m studies.coverage --links 2 4 6 8 16 40 --repetitions 2000

A pool of generated links stands for all links. Samples of a few are drawn from it again and again, and each way to an
interval is tried on each sample: of the score, of the share of AFR's regret, and of the paired difference of two
shares. It should hold the pool's own number in 95 of 100 samples.

Ways: the percentile bootstrap (Efron and Tibshirani 1993, chapter 13); the same with its level widened for few links
(Hesterberg 2015, "What teachers should know about the bootstrap"); BCa (Efron 1987); the bootstrap's
standard error with a quantile of Student's t (the same paper); and the jackknife's standard error with the
same quantile (Efron and Tibshirani 1993, chapter 11).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t
from tqdm import tqdm

from bufgym import policies
from bufgym.benchmark.bootstrap import interval, times_drawn
from bufgym.benchmark.tasks import QueueTask
from bufgym.scenario.numbered import draw
from bufgym.scenario.suites.synthetic import camera, lte_links, motion_value, motions_of
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from studies.page import command, table

POLICIES = ("drop-oldest", "afr", "gap-price", "min-motion-gap")
FIRST_LINK = 500_000
CONFIDENCE = 0.95
Numbers = NDArray[np.float64]
Statistic = Callable[[Numbers], Numbers]


def pool_of(links: int, capacity: int, seeds: int, duration_s: float) -> Numbers:
    """Sums of H over the seeds of each link: float64[links, policies + 1]; the clairvoyant's come last."""
    made = lte_links(FIRST_LINK, links, (3e6, 5e6, 7e6, 9e6))
    scenario = replace(camera(traces=made[:1], motion=motions_of("test"), value=motion_value()), duration_s=duration_s)
    sums = np.zeros((links, len(POLICIES) + 1))
    for k, link in enumerate(tqdm(made, "links", leave=False)):
        of_link = replace(scenario, traces=(link,))
        episodes = [draw(of_link, seeds * k + seed) for seed in range(seeds)]
        for p, name in enumerate(POLICIES):
            senders = run(policies.get(name), episodes, capacity, of_link.value)
            sums[k, p] = math.fsum(outcome(senders, i).qoi for i in range(seeds))
        sums[k, -1] = math.fsum(QueueTask().best(episode, capacity, of_link).qoi for episode in episodes)
    return sums


def score(sums: Numbers) -> Numbers:
    """Of gap-price, from sums over links [..., policies + 1]."""
    return (sums[..., 2] - sums[..., 0]) / (sums[..., -1] - sums[..., 0])


def share(sums: Numbers) -> Numbers:
    """Gap-price's share of AFR's regret."""
    return (sums[..., -1] - sums[..., 2]) / (sums[..., -1] - sums[..., 1])


def difference(sums: Numbers) -> Numbers:
    """The share of gap-price less that of min-motion-gap."""
    return (sums[..., 3] - sums[..., 2]) / (sums[..., -1] - sums[..., 1])


STATISTICS: dict[str, Statistic] = {"score": score, "share": share, "difference": difference}
Way = Callable[[Statistic, Numbers, Numbers], tuple[float, float]]


def percentile(statistic: Statistic, sample: Numbers, weights: Numbers) -> tuple[float, float]:
    """The percentile bootstrap. ``sample`` is [links, policies + 1], ``weights`` [1 + resamples, links]."""
    drawn = statistic(weights @ sample)[1:]
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return low, high


def expanded(statistic: Statistic, sample: Numbers, weights: Numbers) -> tuple[float, float]:
    """The percentile bootstrap at the level that makes a normal mean's interval Student's."""
    n = len(sample)
    level = norm.cdf(-math.sqrt(n / (n - 1)) * t.ppf((1 + CONFIDENCE) / 2, n - 1))
    low, high = np.quantile(statistic(weights @ sample)[1:], [level, 1 - level])
    return low, high


def left_out(statistic: Statistic, sample: Numbers) -> Numbers:
    """The statistic without each link in turn."""
    return statistic(sample.sum(axis=0) - sample)


def bca(statistic: Statistic, sample: Numbers, weights: Numbers) -> tuple[float, float]:
    """Bias-corrected and accelerated."""
    drawn, value = statistic(weights @ sample)[1:], statistic(sample.sum(axis=0))
    bias = norm.ppf(np.clip(np.mean(drawn < value), 1e-4, 1 - 1e-4))
    without = left_out(statistic, sample)
    away = without.mean() - without
    spread = (away**2).sum() ** 1.5
    skew = (away**3).sum() / (6 * spread) if spread > 0 else 0.0
    z = bias + norm.ppf([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    low, high = np.quantile(drawn, norm.cdf(bias + z / (1 - skew * z)))
    return low, high


def student(error: float, statistic: Statistic, sample: Numbers) -> tuple[float, float]:
    """The statistic plus and minus so many standard errors as Student's t says."""
    value = float(statistic(sample.sum(axis=0)))
    width = t.ppf((1 + CONFIDENCE) / 2, len(sample) - 1) * error
    return value - width, value + width


def bootstrap_t(statistic: Statistic, sample: Numbers, weights: Numbers) -> tuple[float, float]:
    """The bootstrap's standard error, widened by sqrt(n / (n - 1)), with Student's t."""
    n = len(sample)
    return student(math.sqrt(n / (n - 1)) * float(np.std(statistic(weights @ sample)[1:])), statistic, sample)


def jackknife_t(statistic: Statistic, sample: Numbers, weights: Numbers) -> tuple[float, float]:
    """The jackknife's standard error with Student's t."""
    n, without = len(sample), left_out(statistic, sample)
    return student(math.sqrt((n - 1) / n * ((without - without.mean()) ** 2).sum()), statistic, sample)


def product(statistic: Statistic, sample: Numbers, weights: Numbers) -> tuple[float, float]:
    """What bufgym prints: from the lower low to the higher high of the widened percentiles and the bootstrap's t."""
    found = interval(statistic(weights @ sample), len(sample))
    return found.low, found.high


WAYS: dict[str, Way] = {
    "percentile": percentile,
    "percentile, widened": expanded,
    "BCa": bca,
    "bootstrap's error, t": bootstrap_t,
    "jackknife's error, t": jackknife_t,
    "bufgym's: the wider of widened and bootstrap's": product,
}


def coverage(
    pool: Numbers, links: int, repetitions: int, resamples: int, rng: np.random.Generator
) -> dict[tuple[str, str], tuple[float, float]]:
    """(Way, statistic) -> the share of samples whose interval holds the pool's number, and the mean width."""
    truth = {name: float(statistic(pool.sum(axis=0))) for name, statistic in STATISTICS.items()}
    held: dict[tuple[str, str], list[Any]] = {(way, name): [] for way in WAYS for name in STATISTICS}
    for _ in range(repetitions):
        sample = pool[rng.integers(len(pool), size=links)]
        weights = times_drawn(links, resamples, rng)
        for way, name in held:
            low, high = WAYS[way](STATISTICS[name], sample, weights)
            held[way, name].append((low <= truth[name] <= high, high - low))
    return {key: tuple(np.mean(found, axis=0).tolist()) for key, found in held.items()}


def page(
    links: Sequence[int] = (2, 4, 6, 8, 16, 40),
    repetitions: int = 2000,
    pool: int = 400,
    capacity: int = 8,
    seeds: int = 2,
    duration_s: float = 60.0,
    resamples: int = 2000,
) -> None:
    """Simulate, and print the table."""
    sums = pool_of(pool, capacity, seeds, duration_s)
    rows = []
    for n in links:
        found = coverage(sums, n, repetitions, resamples, np.random.default_rng(n))
        for way in WAYS:
            cells = [f"{100 * found[way, name][0]:.1f} ({found[way, name][1]:.3f})" for name in STATISTICS]
            rows.append((n, way, *cells))
    print(*table(("links", "way", *(f"{name}, % (width)" for name in STATISTICS)), rows), sep="\n")


if __name__ == "__main__":
    command(page)

"""How often 95 % intervals cover: the table of docs/guide/suites.md, "Intervals and shares".

python -m studies.coverage --links 2 4 6 8 16 40 --repetitions 2000
python -m studies.coverage --links 24 --training-seeds 2 3 4 5 --between 0 .03 .1    # of trained agents
python -m studies.coverage --links 2 4 8 24 --rare .12    # where few links carry most of the loss

A pool of generated links stands for all links. Samples of a few are drawn from it again and again, and each way to an
interval is tried on each sample: of the score, of the share of AFR's regret, and of the paired difference of two
shares. It should hold the pool's own number in 95 of 100 samples.

Ways: the percentile bootstrap (Efron and Tibshirani 1993, chapter 13); the same with its level widened for few links
(Hesterberg 2015, "What teachers should know about the bootstrap"); BCa (Efron 1987); the bootstrap's
standard error with a quantile of Student's t (the same paper); and the jackknife's standard error with the
same quantile (Efron and Tibshirani 1993, chapter 11).

With training seeds gap-price stands for an agent. Training it draws a number from a normal distribution with this
standard deviation between seeds, and moves its score on every link by it. The true number is that of all links and all
trainings. Ways: all drawn together, with degrees of freedom of the links, as bufgym had it once; links and trainings
drawn apart, with the sum of both squared errors and Satterthwaite's or the least degrees of freedom; and what bufgym
prints, ``bootstrap.together``.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t
from tqdm import tqdm

from bufgym import policies
from bufgym.benchmark.bootstrap import interval, times_drawn, together
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


class Trainings(NamedTuple):
    """A sample of links and trainings, and what drawing says of a statistic, [1 + resamples] each."""

    links: int
    seeds: int
    of_links: Numbers
    of_seeds: Numbers
    of_both: Numbers

    @property
    def errors(self) -> tuple[float, float]:
        """Standard errors of links and of seeds, each widened for few."""
        pairs = (self.of_links, self.links), (self.of_seeds, self.seeds)
        first, second = (float(np.std(drawn[1:])) * math.sqrt(n / (n - 1)) for drawn, n in pairs)
        return first, second


def drawn_together(found: Trainings) -> tuple[float, float]:
    """All drawn at once, with degrees of freedom of the links alone."""
    one = interval(found.of_both, found.links)
    return one.low, one.high


def least_degrees(found: Trainings) -> tuple[float, float]:
    """Student's t with the fewer degrees of freedom."""
    return _plain(found, min(found.links, found.seeds) - 1)


def satterthwaite(found: Trainings) -> tuple[float, float]:
    """Student's t with the degrees of freedom of the sum (Satterthwaite 1946)."""
    a, b = (error**2 for error in found.errors)
    return _plain(found, (a + b) ** 2 / (a**2 / (found.links - 1) + b**2 / (found.seeds - 1)))


def _plain(found: Trainings, freedom: float) -> tuple[float, float]:
    reach = t.ppf((1 + CONFIDENCE) / 2, freedom) * math.hypot(*found.errors)
    return found.of_links[0] - reach, found.of_links[0] + reach


def of_levels(found: Trainings) -> tuple[float, float]:
    """What bufgym prints."""
    one = together([(found.of_links, found.links), (found.of_seeds, found.seeds)])
    return one.low, one.high


LEVELS: dict[str, Callable[[Trainings], tuple[float, float]]] = {
    "drawn together, degrees of links": drawn_together,
    "drawn apart, Satterthwaite": satterthwaite,
    "drawn apart, least degrees": least_degrees,
    "bufgym's: drawn apart, reaches added as squares": of_levels,
}


def trained(sample: Numbers, moved: Numbers, resamples: int, rng: np.random.Generator) -> dict[str, Trainings]:
    """Draw links and trainings; ``moved`` [seeds] says by how much each training moves the score."""
    n, k = len(sample), len(moved)
    links, seeds = times_drawn(n, resamples, rng), times_drawn(k, resamples, rng) @ moved / k
    sums, one = links @ sample, np.broadcast_to(sample.sum(axis=0), (1 + resamples, sample.shape[1]))

    def agents(sums: Numbers, moves: Any) -> Numbers:
        own = sums.copy()
        own[:, 2] += moves * (sums[:, -1] - sums[:, 0])
        return own

    both = agents(sums, moved.mean()), agents(one, seeds), agents(sums, seeds)
    return {name: Trainings(n, k, *map(statistic, both)) for name, statistic in STATISTICS.items()}


def coverage_of_trainings(
    pool: Numbers, links: int, seeds: int, between: float, repetitions: int, resamples: int, rng: np.random.Generator
) -> dict[tuple[str, str], tuple[float, float]]:
    """``coverage`` of agents whose score has this standard deviation between trainings."""
    truth = {name: float(statistic(pool.sum(axis=0))) for name, statistic in STATISTICS.items()}
    held: dict[tuple[str, str], list[Any]] = {(way, name): [] for way in LEVELS for name in STATISTICS}
    for _ in range(repetitions):
        sample = pool[rng.integers(len(pool), size=links)]
        drawn = trained(sample, rng.normal(0, between, seeds), resamples, rng)
        for way, name in held:
            low, high = LEVELS[way](drawn[name])
            held[way, name].append((low <= truth[name] <= high, high - low))
    return {key: tuple(np.mean(found, axis=0).tolist()) for key, found in held.items()}


def with_rare(pool: Numbers, rare: float) -> Numbers:
    """The pool, on this share of whose links 100 times as much is lost, by every policy as much as by Drop Oldest."""
    loss, many = pool[:, -1:] - pool, round(rare * len(pool))
    loss[:many, :-1] = 100 * loss[:many, :1]
    return np.asarray(loss.max() - loss)


def page(
    links: Sequence[int] = (2, 4, 6, 8, 16, 40),
    repetitions: int = 2000,
    pool: int = 400,
    capacity: int = 8,
    seeds: int = 2,
    duration_s: float = 60.0,
    resamples: int = 2000,
    training_seeds: Sequence[int] = (),
    between: Sequence[float] = (0.0, 0.03, 0.1),
    rare: float = 0.0,
) -> None:
    """Simulate, and print the table; with ``training_seeds`` for each number of trainings and spread between them."""
    sums = with_rare(pool_of(pool, capacity, seeds, duration_s), rare)
    rows: list[tuple[object, ...]] = []
    for n in links:
        if not training_seeds:
            rows += _cells((n,), coverage(sums, n, repetitions, resamples, np.random.default_rng(n)))
        for count, spread in itertools.product(training_seeds, between):
            rng = np.random.default_rng([n, count])
            found = coverage_of_trainings(sums, n, count, spread, repetitions, resamples, rng)
            rows += _cells((n, count, spread), found)
    head = ("links", *(("training seeds", "between them") if training_seeds else ()), "way")
    print(*table((*head, *(f"{name}, % (width)" for name in STATISTICS)), rows), sep="\n")


def _cells(
    first: tuple[object, ...], found: dict[tuple[str, str], tuple[float, float]]
) -> Iterator[tuple[object, ...]]:
    """A line of the table for each way."""
    for way in dict.fromkeys(way for way, _ in found):
        held = (found[way, name] for name in STATISTICS)
        yield (*first, way, *(f"{100 * share:.1f} ({width:.3f})" for share, width in held))


if __name__ == "__main__":
    command(page)

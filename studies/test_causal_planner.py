"""The causal planner: laws of its futures, what it learns from what a robot sees, and its values."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from needs import needs

pytest.importorskip("sb3_contrib", reason=needs("extras", "sb3_contrib"))

from bufgym.benchmark.tasks import QueueTask
from bufgym.jit import JIT
from bufgym.policies import Policy
from bufgym.scenario import Episode, Uplink
from bufgym.scenario.numbered import draw
from bufgym.sim import outcome, run
from bufgym.traces import Trace, drive_motion, synthetic_lte
from studies import causal_planner, futures

TRAIN = [("train", 9e6)]
planned = pytest.mark.skipif(not JIT, reason=needs("compiled", "without compilation a plan takes seconds"))


def rates_of(trace: Trace) -> np.ndarray[Any, Any]:
    """The rate of each second, bytes/s."""
    return np.asarray(trace.samples()[1], float)


def test_futures_follow_the_generators_law() -> None:
    """Far ahead, the rates are those of ``synthetic_lte``: mean, breakdowns, and the correlation over a second."""
    links = futures.prior(TRAIN, np.random.default_rng(1))
    drawn = futures.Belief(links, np.random.default_rng(2)).futures(1000, 30)[:, 5:]
    made = np.array([rates_of(synthetic_lte(seed, 300, 9e6, "train")) for seed in range(100)])
    assert drawn.mean() == pytest.approx(made.mean(), rel=0.03)
    assert (drawn == 0).mean() == pytest.approx((made == 0).mean(), abs=0.01)
    assert np.quantile(drawn, [0.25, 0.5, 0.75]) == pytest.approx(np.quantile(made, [0.25, 0.5, 0.75]), rel=0.06)
    together = [np.corrcoef(each[:, :-1].ravel(), each[:, 1:].ravel())[0, 1] for each in (drawn, made)]
    assert together[0] == pytest.approx(together[1], abs=0.05)


def test_the_filter_forecasts_better_than_the_last_rate_and_than_the_mean() -> None:
    """Over 600 s of two links: squared errors a second ahead, and how often the rate falls between the quartiles."""
    links = futures.prior([(mode, mean) for mode in ("walk", "train") for mean in (5e6, 9e6)], np.random.default_rng(0))
    errors, between = [], []
    for seed in (5000, 5001):
        trace = rates_of(synthetic_lte(seed, 300, 9e6, "train"))
        belief = futures.Belief(links, np.random.default_rng(seed))
        for now, then in itertools.pairwise(trace):
            belief.second(float(now))
            forecast = belief.futures(200, 2)
            # The present rate is known, but for the noise on a particle at the ceiling.
            assert forecast[:, 0] == pytest.approx(np.full(200, now), rel=5 * futures.JITTER)
            low, high = np.quantile(forecast[:, 1], [0.25, 0.75])
            between.append(low <= then <= high)
            errors.append([(guess - then) ** 2 for guess in (forecast[:, 1].mean(), now, trace.mean())])
    found, last, mean = np.mean(errors, axis=0)
    assert found < 0.95 * last
    assert found < 0.7 * mean
    assert np.mean(between) == pytest.approx(0.5, abs=0.07)


def test_a_breakdown_ends_and_the_unseen_seconds_widen_the_belief() -> None:
    belief = futures.Belief(futures.prior(TRAIN, np.random.default_rng(0)), np.random.default_rng(1))
    for rate in (9e6, 8.7e6, 9.1e6):
        belief.second(rate)
    before = belief.futures(2000, 2)[:, 1].std()
    for _ in range(5):
        belief.second(None)
    assert belief.futures(2000, 2)[:, 1].std() > before
    belief.second(0.0)
    stays = belief.futures(2000, 2)
    assert (stays[:, 0] == 0).all()
    assert 0.6 < (stays[:, 1] == 0).mean() < 0.95  # a mean of 4.5 s: 1 - 1/4.5 at most, as none is over 20 s


def test_seconds_of_the_trace_are_found_by_a_change_of_the_rate() -> None:
    """8 MB/s until 0.65 s, then 4 MB/s: the next second begins at 1.65 s, and until then the rate is known."""
    seen = futures.LinkSeen(futures.prior([("walk", 6e6)], np.random.default_rng(0)), np.random.default_rng(1))
    ends, news, before = np.arange(1, 31) * 33_333, [], 0
    for now in ends.tolist():
        sent = (
            8 * min(now, 650_000) + 4 * max(now - 650_000, 0) - 8 * min(before, 650_000) - 4 * max(before - 650_000, 0)
        )
        news.append(seen.arrival(before, now, sent, now - before))
        before = now
    assert [k for k, new in enumerate(news) if new] == [0, 20]  # the 20th ends at 0.667 s; its rate is of two seconds
    carried = seen.carried(before, before + np.array([0.0, 3e5, 1_649_500 - before, 4e6]), 50)
    assert (carried[:, :3] == 4 * np.array([0, 3e5, 1_649_500 - before])).all()
    assert len(set(carried[:, 3].tolist())) > 10


def test_a_drive_keeps_its_pace_until_its_phase_is_over() -> None:
    seen = futures.DriveSeen(np.random.default_rng(0))
    for k in range(30):  # 1 s of standing, then a cruise of 0.5 a second
        seen.arrival(100_000 * k, 100_000 * (k + 1), 0.0 if k < 10 else 0.05)
    moved = seen.moved(3_000_000, 3e6 + np.array([0.0, 1e6, 2e6, 1e7, 3e7]), 400)
    assert moved[:, :3] == pytest.approx(np.tile([0.0, 0.5, 1.0], (400, 1)))  # a cruise takes 4 s at least
    assert (np.diff(moved) >= 0).all()
    far = [np.diff(drive_motion(seed).at(np.array([100_000_000, 120_000_000])))[0] for seed in range(400)]
    assert np.diff(moved[:, 3:]).mean() == pytest.approx(np.mean(far), rel=0.1)


def scenario_of(*traces: Trace) -> Uplink:
    """Ten seconds of a camera on a driving robot, whose link sends a tenth of the frames."""
    stream = Uplink(traces, motion=(drive_motion(3),), size_bytes=2_000_000, duration_s=10.0)
    return replace(stream, jitter=0.0)


def planner_for(scenario: Uplink, **changes: Any) -> causal_planner.CausalPlanner:
    planning = replace(causal_planner.Planning(8, 10.0, True), **changes)
    return causal_planner.CausalPlanner(planning, futures.prior(TRAIN, np.random.default_rng(0), 3000), scenario, 4, 0)


def played(scenario: Uplink, episode: Episode, planner: causal_planner.CausalPlanner) -> float:
    return outcome(run(Policy("planner", planner.on_arrival), [episode], 4, scenario.value), 0).qoi


@planned
def test_a_planner_that_is_told_the_future_is_the_clairvoyant(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the true link and motion for each future, every decision is a best one, so H is the clairvoyant's."""
    scenario = scenario_of(synthetic_lte(1, mean_bytes_per_s=6e6, mode="train"))
    episode = draw(scenario, 4)
    planner = planner_for(scenario, futures=1)
    planner._stride = 1
    x, us = episode.arrivals["x"], episode.arrivals["arrival_us"]

    def carried(seen: Any, now_us: int, times_us: Any, count: int) -> Any:
        true = episode.link.carried_by(us)
        k = int(np.searchsorted(us, now_us))
        return np.tile(true[k : k + len(times_us)] - true[k], (count, 1))

    def moved(seen: Any, now_us: int, times_us: Any, count: int) -> Any:
        k = int(np.searchsorted(us, now_us))
        return np.tile(x[k : k + len(times_us)] - x[k], (count, 1))

    monkeypatch.setattr(futures.LinkSeen, "carried", carried)
    monkeypatch.setattr(futures.DriveSeen, "moved", moved)
    plan = QueueTask().best(episode, 4, scenario)
    assert plan.certified
    assert played(scenario, episode, planner) == pytest.approx(plan.qoi, abs=1e-9)


@planned
def test_decisions_do_not_depend_on_the_future() -> None:
    """Two links that are the same for 5 s: until then the planner keeps the same messages."""
    lengths_us, rates = synthetic_lte(2, 20, 6e6, "train").samples()
    steps = [(float(us) / 1e6, float(rate)) for us, rate in zip(lengths_us, rates, strict=True)]
    kept = []
    for later in (steps[5:], [(15.0, 2e7)]):
        scenario = replace(scenario_of(Trace.steps([*steps[:5], *later])), random_offset=False)
        episode = draw(scenario, 0)
        senders = run(Policy("planner", planner_for(scenario).on_arrival), [episode], 4, scenario.value)
        kept.append(senders.batch.log["dropped_us"][0])
    before = (kept[0] < 5_000_000) & (kept[1] < 5_000_000)
    assert (kept[0][before] == kept[1][before]).all()
    assert before[:100].sum() > 50
    assert (kept[0] != kept[1]).any()

"""Scenarios: every draw keeps to its parameters, and two policies meet the same episode."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from cases import log, trace, watched
from hypothesis import given
from hypothesis import strategies as st
from refusal_cases import refused

from bufgym import scenario
from bufgym.model.link import FOREVER
from bufgym.scenario import SCENARIOS, FleetScenario, Interruption, Streams, Uplink
from bufgym.scenario.draws import place
from bufgym.sim import run
from bufgym.traces import Motion
from bufgym.traces.workload import Workload

STEADY = trace([(0, 0), (1_000_000, 5_000_000)], "loop")
FADING = trace([(0, 0), (500_000, 4_000_000), (900_000, 4_000_000), (1_000_000, 4_100_000)], "loop")
WALK = Motion("walk", np.array([0, 400_000, 1_000_000], np.int64), np.array([0.0, 0.0, 1.5]))


@pytest.mark.parametrize("T", [1, 9, 40])
def test_an_interruption_is_one(T):
    # Message 0 is on the link when it stops, 1..T meet the policy, then all that is kept is sent, and T + 1 after it.
    made = Interruption(t_max=40, rate_hz=30)
    policy, asked = watched(lambda buffer, arrival: (int(arrival.seq), buffer.busy, buffer.left_bytes))
    senders = run(policy, [made.episode(T)], 50, made.value)
    assert asked == [(k, 1, 230_000) for k in range(1, T + 1)]
    transmitted_us = log(senders)["transmitted_us"]
    assert len(transmitted_us) == T + 2
    resumes_us = T * 33_333 + 33_333 // 2
    assert all(resumes_us < transmitted_us[k] <= resumes_us + 1 for k in range(T + 1))
    assert 0 < transmitted_us[T + 1] - (T + 1) * 33_333 <= 1


@given(st.floats(0, 1), st.floats(1, 200), st.floats(0, 3), st.booleans(), st.integers(0, 2**32))
def test_uplink_draws_are_well_formed(jitter, rate_hz, size_cv, random_offset, seed):
    varied = {"rate_hz": rate_hz, "jitter": jitter, "size_cv": size_cv, "random_offset": random_offset}
    drawn = Uplink((STEADY, FADING), (WALK,), duration_s=3, **varied)
    episode = drawn.draw(Streams.seeded(seed))
    arrivals = episode.arrivals
    n = len(arrivals)
    assert n == drawn.max_messages == round(3 * rate_hz)
    assert arrivals["seq"].tolist() == list(range(n))
    assert arrivals["arrival_us"][0] == 0
    assert (np.diff(arrivals["arrival_us"]) >= 0).all()
    # Each at most one jitter away from its turn, and so is the first, from which time counts.
    assert np.abs(arrivals["arrival_us"] * rate_hz / 1e6 - np.arange(n)).max() <= jitter + 2e-6 * rate_hz
    assert arrivals["size_bytes"].min() >= 1
    assert arrivals["x"][0] == 0 and (np.diff(arrivals["x"]) >= 0).all()
    assert 0 <= episode.link.offset_us < 1_000_000
    if not random_offset:
        assert episode.link.offset_us == 0
        assert arrivals["x"] == pytest.approx(WALK.at(arrivals["arrival_us"]))


def test_scales_sizes_and_x_without_motion():
    drawn = Uplink(traces=(STEADY,), scale=(0.5, 2.0), duration_s=0.1)
    assert {drawn.draw(Streams.seeded(k)).link.trace.total_bytes for k in range(20)} == {2_500_000, 10_000_000}
    arrivals = Uplink(traces=(STEADY,), duration_s=1).draw(Streams.seeded(0)).arrivals
    assert arrivals["x"].tolist() == list(range(30)) and (arrivals["size_bytes"] == 230_000).all()
    drawn = Uplink(traces=(STEADY,), size_bytes=100_000, size_cv=0.5, rate_hz=1000, duration_s=20)
    size = drawn.draw(Streams.seeded(3)).arrivals["size_bytes"]
    # 20,000 draws: the mean is known to 0.5 / sqrt(20000) = 0.35 %, the coefficient of variation to about 1 %.
    assert size.mean() == pytest.approx(100_000, rel=0.015)
    assert size.std() / size.mean() == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize("name", SCENARIOS)
def test_same_seed_same_episode(name):
    made = scenario.get(name)
    a, b, c = (made.draw(Streams.seeded(seed)) for seed in (5, 5, 6))
    assert (a.arrivals == b.arrivals).all()
    assert a.link == b.link
    assert len(a.arrivals) <= made.max_messages
    assert a.link != c.link or name == "afr-evaluation"  # which begins at its link's start


def test_streams_are_separate():
    made = Uplink(traces=(STEADY, FADING), size_cv=0.3, duration_s=1)
    plain, spent = Streams.seeded(9), Streams.seeded(9)
    # Whatever a policy draws, or another link is drawn with, the workload stays; and the other way round.
    spent.policy.random(100)
    spent.link.random(100)
    a, b = made.draw(plain), made.draw(spent)
    assert (a.arrivals == b.arrivals).all()
    assert a.link != b.link
    spent = Streams.seeded(9)
    spent.arrival.random(100)
    b = made.draw(spent)
    assert (a.arrivals != b.arrivals).any()
    assert a.link == b.link
    # No two streams are alike.
    assert len({stream.random() for stream in Streams.seeded(9)}) == 3


@pytest.mark.parametrize(
    "changes",
    [{"rate_hz": 60.0}, {"jitter": 0.9}, {"size_cv": 0.5}, {"rate_hz": 7, "jitter": 0, "size_cv": 1}],
    ids=str,
)
def test_other_rates_jitters_and_sizes_meet_the_same_motion_and_link(changes, monkeypatch):
    places = []

    def noted(recordings, rng, random_offset):
        motion, start_us = place(recordings, rng, random_offset)
        places.append((motion.name, start_us))
        return motion, start_us

    monkeypatch.setattr("bufgym.scenario.uplink.place", noted)
    made = Uplink(traces=(STEADY, FADING), motion=(WALK, replace(WALK, name="again"), replace(WALK, name="on")))
    links = []
    for scenario_ in (made, replace(made, **changes)):
        streams = Streams.seeded(4)
        links += [scenario_.draw(streams).link for _ in range(4)]  # one after the other, as an environment does
    assert places[:4] == places[4:] and links[:4] == links[4:]
    assert len(set(places)) == 4


def test_text_names_several_recordings_with_commas_between(tmp_path, monkeypatch):
    """A file whose own name has a comma is one; beside others it stands in a list."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slow,fast").write_text("0 8\n1 8\n")
    made = scenario.get("lte", traces=["lte-synthetic-1, 8Mbit/s,", "slow,fast"], motion="drive-1,drive-0")
    assert [one.name for one in made.traces] == ["lte-synthetic-1", "8Mbit/s", "slow,fast"]
    assert [one.name for one in made.motion] == ["drive-1", "drive-0"]


test_what_is_refused = refused(
    (lambda: Interruption(law="normal"), "law = 'normal': must be one of fixed, uniform, log-uniform, geometric"),
    (lambda: Interruption(t_min=0), "t_min = 0, t_max = 400"),
    (lambda: Interruption(t_min=9, t_max=8), "t_min = 9, t_max = 8"),
    (lambda: Interruption(law="geometric", t_mean=0.5), "t_mean = 0.5: must be at least t_min = 1"),
    (lambda: Interruption(rate_hz=0), "rate_hz = 0: must be a number > 0"),
    (lambda: Interruption(value=0.618), "value = 0.618: must be a bufgym.model.qoi Value"),
    (lambda: Interruption(size_bytes=10**18), "size_bytes = 1000000000000000000: must be at most 10000000000"),
    (lambda: Interruption(rate_hz=1e-6), "t_max = 400 messages at rate_hz = 1e-06: must arrive"),
    (lambda: Interruption(t_max=40).episode(0), "T = 0: must lie between 1 and t_max = 40"),
    (lambda: uplink(traces=()), "traces: an uplink needs at least one"),
    (lambda: uplink(traces="lte-synthetic-0,lte-a"), "^lte-a: no such file, and no shipped trace"),
    (lambda: uplink(traces=","), "traces: an uplink needs at least one"),
    (lambda: uplink(traces="lte-a"), "lte-a: no such file, and no shipped trace"),
    (lambda: uplink(scale=(1.0, 0.0)), r"scale = \(1.0, 0.0\): every factor"),
    (lambda: uplink(jitter=1.5), "jitter = 1.5: must lie between 0 and 1"),
    (lambda: uplink(duration_s=0.001), "rate_hz x duration_s = 0 messages"),
    (lambda: uplink(duration_s=1e9, rate_hz=1e-6), "duration_s = 1000000000.0: must be at most 10000000"),
    (lambda: uplink(rate_hz=1e-300), "rate_hz = 1e-300: must be at most 100000, and at least 1e-07"),
    (lambda: uplink(propagation_us=-5), "propagation_us = -5: must be a whole number from 0 to 10000000000000"),
    (lambda: Streams.seeded(-1), "seed = -1"),
)


def uplink(**parameters):
    return Uplink(**{"traces": (STEADY,), **parameters})


@pytest.mark.parametrize("workload", [None, Workload("played", np.array([0, 70_000]), np.array([1, 1]))])
def test_the_sender_is_told_how_long_the_stream_lasts_if_the_scenario_says_so(workload):
    told = uplink(duration_s=2.5, tells_duration=True, workload=workload)
    drawn, not_told = told.draw(Streams.seeded(1)), replace(told, tells_duration=False).draw(Streams.seeded(1))
    assert drawn.ends_us == (2_500_000 if workload is None else 70_000) and not_told.ends_us is None
    assert np.array_equal(drawn.arrivals, not_told.arrivals)
    if workload is None:
        assert FleetScenario(2, told).draw(Streams.seeded(1)).episode(1).ends_us == 2_500_000
    policy, seen = watched(lambda buffer, arrival: buffer.remaining_us)
    for episode in (drawn, not_told):
        run(policy, [episode], 3, told.value)
    n = len(drawn.arrivals)
    assert seen[:n] == (drawn.ends_us - drawn.arrivals["arrival_us"]).tolist()
    assert set(seen[n:]) == {FOREVER}


def test_get():
    assert scenario.get("interruption", t_max=7).t_max == 7
    assert scenario.get("lte") is scenario.get("lte")
    made = Interruption(law="log-uniform", t_min=500, t_max=600)  # a law looks at its own parameters only
    assert scenario.get(made) is made and made.t_mean == 100
    with pytest.raises(FrozenInstanceError):
        made.rate_hz = 5

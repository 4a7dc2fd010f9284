"""Laws of message sizes: their mean, spread and memory, what goes with them."""

import re

import numpy as np
import pytest
from refusal_cases import refuse

from bufgym import scenario, traces
from bufgym.cli import main
from bufgym.model.topics import Topic
from bufgym.scenario import Client, FleetScenario, Interruption, Stream, Streams
from bufgym.traces.generate.sizes import Moving, drawn, recorded, recorded_sizes

MEAN = 100_000
DRIVE = traces.load_motion("drive-0")
LAWS = ["jpeg", "gop", "depth-colour", "motion", "recorded:7scenes-rvl", "recorded:7scenes-rvl-jpeg"]


def sample(law: str, n: int = 60_000, seed: int = 3) -> np.ndarray:
    return drawn(law, n, MEAN, np.random.default_rng(seed), Moving(DRIVE, np.arange(n, dtype=np.int64) * 33_333))


@pytest.mark.parametrize("law", ["jpeg:rho=0.5", "gop:rho=0.5", "depth-colour:rho=0.5", "motion", *LAWS[4:]])
def test_the_mean_is_the_asked_one(law: str) -> None:
    drawn_sizes = sample(law)
    assert drawn_sizes.dtype == np.int64 and drawn_sizes.min() >= 1
    assert drawn_sizes.mean() == pytest.approx(MEAN, rel=0.02)


@pytest.mark.parametrize("law", ["gop:every=7,ratio=9", "depth-colour:ratio=4"])
def test_the_mean_of_one_message_is_the_asked_one(law: str) -> None:
    """Even of the first, because a group begins anywhere."""
    quiet = law + ",cv=0,noise=0"
    first = [drawn(quiet, 1, MEAN, np.random.default_rng(seed))[0] for seed in range(6000)]
    assert np.mean(first) == pytest.approx(MEAN, rel=0.05)


def test_jpeg_has_the_stated_spread_and_memory() -> None:
    log_size = np.log(sample("jpeg:rho=0.9,cv=0.4,noise=0.15", 200_000))
    slow, anew = np.log1p(0.4**2), np.log1p(0.15**2)
    about = log_size - log_size.mean()
    assert about.var() == pytest.approx(slow + anew, rel=0.03)
    for lag in (1, 5):
        assert (about[lag:] * about[:-lag]).mean() == pytest.approx(slow * 0.9**lag, rel=0.05)


def test_groups_and_turns_without_spread_are_as_by_hand() -> None:
    group = drawn("gop:every=3,ratio=4,cv=0,noise=0", 9, 600, np.random.default_rng(0))
    assert sorted(group.tolist()) == [300] * 6 + [1200] * 3
    assert (np.diff(np.flatnonzero(group == 1200)) == 3).all()
    turns = drawn("depth-colour:ratio=4,cv=0,noise=0", 6, 500, np.random.default_rng(0))
    assert sorted(turns.tolist()) == [200] * 3 + [800] * 3 and (np.diff(turns) != 0).all()


def test_motion_sizes_follow_the_speed() -> None:
    motion = traces.Motion("two", np.array([0, 10**6, 2 * 10**6]), np.array([0.0, 0.0, 1.0]))
    times = np.array([500_000, 1_500_000])
    still, fast = drawn("motion:exponent=1,noise=0", 2, 1100, np.random.default_rng(0), Moving(motion, times))
    # Speeds 0 and 2 times the mean, whose mean is 1.
    assert (still, fast) == (100, 2100)
    resting = traces.Motion("still", np.array([0, 10**6]), np.zeros(2))
    assert (drawn("motion:noise=0", 2, 1000, np.random.default_rng(0), Moving(resting, times)) == 1000).all()


def test_a_recorded_sequence_is_played_in_a_loop_from_a_random_place() -> None:
    for name in recorded():
        whole = recorded_sizes(name)
        played = drawn(f"recorded:{name}", 2 * len(whole), float(whole.mean()), np.random.default_rng(5))
        start = np.random.default_rng(5).integers(len(whole))
        assert np.array_equal(played, np.tile(np.roll(whole, -start), 2))
    turns = recorded_sizes("7scenes-rvl-jpeg")
    assert np.array_equal(turns[0::2], recorded_sizes("7scenes-rvl"))
    assert np.array_equal(turns[1::2], recorded_sizes("7scenes-jpeg90"))


def test_bad_text_and_what_does_not_go_together_are_refused_in_one_sentence() -> None:
    for text, says in (
        ("jpg", "unknown sizes 'jpg'; did you mean 'jpeg'?"),
        ("jpeg:cvv=1", "did you mean 'cv'?"),
        ("jpeg:cv", "not of the form parameter=number"),
        ("jpeg:cv=-1", "must be a number from 0 to 10"),
        ("gop:every=2.5", "must be a whole number"),
        ("equal:cv=1", "has no parameters"),
        ("recorded:7scenes-rlv", "did you mean '7scenes-rvl'?"),
        ("recorded", "known: 7scenes-rvl"),
        (3, "must be text"),
    ):
        refuse(re.escape(says), scenario.get, "lte", sizes=text)
    refuse("must not both be given", scenario.get, "lte", sizes="jpeg", size_cv=0.5)
    for made in (
        lambda: scenario.get("lte", sizes="motion", motion="none"),
        lambda: Interruption(sizes="motion"),
        lambda: Stream(Topic("a"), 5, 100, sizes="motion"),
    ):
        refuse("needs a motion recording", made)


@pytest.mark.parametrize("law", LAWS)
def test_nothing_but_the_sizes_changes(law: str) -> None:
    equal, varied = scenario.get("lte", duration_s=5.0), scenario.get("lte", duration_s=5.0, sizes=law)
    one, other, again = (made.draw(Streams.seeded(7)) for made in (equal, varied, varied))
    assert (one.link.trace.name, one.link.offset_us) == (other.link.trace.name, other.link.offset_us)
    for field in ("arrival_us", "x", "topic", "seq"):
        assert np.array_equal(one.arrivals[field], other.arrivals[field])
    assert np.array_equal(other.arrivals, again.arrivals) and np.ptp(other.arrivals["size_bytes"]) > 0
    fleet = FleetScenario.of(3, varied).draw(Streams.seeded(7))
    plain = FleetScenario.of(3, equal).draw(Streams.seeded(7))
    assert np.array_equal(fleet.arrivals[0]["size_bytes"], other.arrivals["size_bytes"])
    assert not np.array_equal(fleet.arrivals[1]["size_bytes"], fleet.arrivals[2]["size_bytes"])
    assert all(np.array_equal(a["x"], b["x"]) for a, b in zip(fleet.arrivals, plain.arrivals, strict=True))


@pytest.mark.parametrize("law", ["jpeg", "motion"])
def test_a_client_gives_the_law_to_the_streams_that_move(law: str) -> None:
    plain = scenario.get("topics", duration_s=5.0)
    assert isinstance(plain, Client)
    streams = tuple(Stream(s.topic, s.rate_hz, s.size_bytes, moves=s.moves) for s in plain.streams)
    plain = scenario.get(plain, streams=streams)
    one, other = (made.draw(Streams.seeded(2)).arrivals for made in (plain, scenario.get(plain, sizes=law)))
    for field in ("arrival_us", "x", "topic"):
        assert np.array_equal(one[field], other[field])
    moves = np.array([stream.moves for stream in streams])[one["topic"]]
    assert np.array_equal(one["size_bytes"][~moves], other["size_bytes"][~moves])
    assert (one["size_bytes"] != other["size_bytes"])[moves].mean() > 0.9


def test_an_interruption_has_sizes_too() -> None:
    one, other = (made.draw(Streams.seeded(4)) for made in (Interruption(), Interruption(sizes="jpeg")))
    assert len(one.arrivals) == len(other.arrivals) and one.link.offset_us == other.link.offset_us
    assert np.ptp(other.arrivals["size_bytes"]) > 0


def test_a_generated_workload_has_the_law_and_is_read_back(tmp_path, capsys) -> None:
    for motion, law in (("drive-0", "motion"), ("none", "jpeg")):
        file = tmp_path / f"{law}.csv"
        words = ["--sizes", law, "--motion", motion, "--duration", "20", "--fps", "10", "--bytes", "5000"]
        assert main(["trace", "generate", "workload", *words, "--out", str(file)]) in (0, None)
        made = traces.read_workload(str(file))
        assert len(made) == 200 and np.ptp(made.size_bytes) > 0 and (made.x is None) == (motion == "none")
        assert f"200 messages, mean {made.size_bytes.mean():,.0f} bytes" in capsys.readouterr().out


def test_a_topic_of_a_file_has_sizes(tmp_path) -> None:
    file = tmp_path / "client.toml"
    file.write_text('[[topic]]\nname = "a"\nrate_hz = 5\nsize_bytes = 100\nsizes = "gop:every=3,cv=0,noise=0"\n')
    drawn_sizes = scenario.read_client(file, duration_s=6.0).draw(Streams.seeded(0)).arrivals["size_bytes"]
    assert sorted(set(drawn_sizes.tolist())) == [50, 200]

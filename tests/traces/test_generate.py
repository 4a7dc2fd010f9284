"""Links and motions from a seed: rules by hand, chance by its laws, shipped files, `trace generate`."""

import gzip
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import link_files
import numpy as np
import pytest
from cli_cases import Capsys, fails, shown
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusal_cases import refuse

from bufgym import policies, scenario, traces
from bufgym.benchmark import drops
from bufgym.traces import (
    Motion,
    Trace,
    Workload,
    load,
    load_motion,
    read_motion,
    read_trace,
    read_workload_csv,
    synthetic_lte,
    write_workload_csv,
)
from bufgym.traces.formats.recordings import read_workload
from bufgym.traces.generate.driving import drive_motion
from bufgym.traces.generate.markov import MAX_OUTAGE_S, link_rates, markov_link
from bufgym.traces.generate.parameters import LINKS, LinkParameters, OutageParameters, fitted_links, read_links
from bufgym.traces.generate.rules import ramp, steady, tunnel
from bufgym.utils.errors import TraceError

MODES = ("bicycle", "bus", "car", "foot", "train", "tram")
SEEDED: Any = (lambda seed: markov_link("tram", seed, 120), lambda seed: synthetic_lte(seed, 120))

# 8 Mbit/s = 1 MB/s everywhere outside outages, nothing inside.
FLAT = LinkParameters(1, 1000, (1e6,) * 11, 0.0, 0.0, 10.0, 0.0, None)
OUTAGES = OutageParameters(20, 0.5, 4.0, 60.0, 1.0, 2.0, 2.0, (0.0,) * 5)
RATES = tuple(1e6 * k for k in range(1, 12))
KNOWN = LinkParameters(1, 1000, RATES, 0.2, 0.4, 50.0, 0.3, replace(OUTAGES, long_gap_s=4.0, shoulder=0.5))


def test_a_seed_is_a_trace_whose_bytes_never_change() -> None:
    for make in SEEDED:
        assert make(5) == make(5)
        assert make(5).cumulative_bytes.tolist() != make(6).cumulative_bytes.tolist()
    # Results are quoted on seeds: a generator that changes is a new generator, under a new name.
    link = markov_link("known", 2, 12, links={"known": KNOWN})
    # Lowered from the seventh on, for then an outage begins.
    lowered = [6621400, 6654152, 3027288, 2683391, 1422412, 1261835, 1853449, 0]
    assert np.diff(link.cumulative_bytes).tolist()[4:] == lowered
    assert synthetic_lte(1, duration_s=1).duration_us == 1_000_000


@given(seed=st.integers(0, 2**32), seconds=st.integers(1, 400), mode=st.sampled_from(MODES))
def test_links_never_run_backwards_and_a_longer_one_begins_as_the_shorter(seed: int, seconds: int, mode: str) -> None:
    trace = markov_link(mode, seed, seconds)
    assert trace.duration_us == seconds * 1_000_000
    bytes_per_s = np.diff(trace.cumulative_bytes)
    assert (bytes_per_s >= 0).all() and bytes_per_s.max() <= fitted_links()[mode].quantiles_bytes_per_s[-1]
    longer = markov_link(mode, seed, seconds + 50).cumulative_bytes[: seconds + 1]
    assert longer.tolist() == trace.cumulative_bytes.tolist()
    assert abs(markov_link(mode, seed, seconds, mean_bytes_per_s=7.5e6).total_bytes - seconds * 7.5e6) <= seconds / 2


def test_a_link_without_outages_keeps_its_quantiles() -> None:
    """Rates of 1 to 11 MB/s at the tabled probabilities: a tenth lies under 4 MB/s, half under 6, a tenth over 8."""
    link = replace(FLAT, quantiles_bytes_per_s=KNOWN.quantiles_bytes_per_s, level_share=0.5, fast_memory=0.5)
    rates = link_rates(link, 1, 40_000)
    for bound, share in ((4e6, 0.1), (6e6, 0.5), (8e6, 0.9)):
        assert abs((rates < bound).mean() - share) < 0.02
    # Memory: level 0.6 that stays 20 s, fast 0.4 with 0.5: after 5 s 0.6 x 0.95**5 + 0.4 x 0.5**5 = 0.477.
    linear = tuple(5e6 + 1e6 * z for z in (-3, -2.326348, -1.644854, -1.281552, -0.67449, 0))
    linear += tuple(1e7 - rate for rate in linear[-2::-1])
    link = replace(FLAT, quantiles_bytes_per_s=linear, level_share=0.6, level_stay_s=20.0, fast_memory=0.5)
    rates = link_rates(link, 2, 100_000)
    centred = rates - rates.mean()
    assert abs((centred[5:] * centred[:-5]).mean() / rates.var() - 0.477) < 0.03


def test_outages_are_as_long_and_as_far_apart_as_stated() -> None:
    """P(over k s) = (1 + k / 2)**-2: 4/9 go on beyond 1 s, 1/4 beyond 2 s. Gaps: half of mean 4 s, half of 60 s."""
    rates = link_rates(replace(FLAT, outages=OUTAGES), 4, 100_000)
    edges = np.flatnonzero(np.diff(np.concatenate(([1], rates > 0, [1])).astype(int)))
    lengths, gaps = edges[1::2] - edges[::2], edges[2::2] - edges[1:-1:2]
    assert [(lengths > 1).mean(), (lengths > 2).mean()] == pytest.approx([4 / 9, 1 / 4], abs=0.03)
    assert abs(gaps.mean() - 32) < 2 and lengths.max() <= MAX_OUTAGE_S
    # Rates beside outages are lowered by half within 5 s; never below the least rate outside of one.
    lowered = replace(FLAT, quantiles_bytes_per_s=(0.3e6, *(1e6,) * 10), outages=replace(OUTAGES, shoulder=0.5))
    rates = link_rates(lowered, 1, 2000)
    start = int(np.argmax(rates == 0))
    assert rates[start - 6 : start].tolist() == [1e6, 5e5, 5e5, 5e5, 5e5, 5e5]
    assert link_rates(replace(lowered, outages=replace(OUTAGES, shoulder=0.1)), 1, 2000)[start - 1] == 0.3e6
    # Yet the first second of a link carries something.
    worst = replace(FLAT, outages=replace(OUTAGES, long_gap_s=1.0, short_gap_s=1.0, shoulder=0.5))
    assert all(markov_link("worst", seed, 1, links={"worst": worst}).total_bytes > 0 for seed in range(20))


def test_links_by_rule() -> None:
    """12.5 to 0.5 MB/s in 15 s: 6.5 MB/s in the mean; half-way, after 7.5 s, (12.5 + 6.5) / 2 x 7.5 = 71.25 MB."""
    trace = ramp(100e6 / 8, 4e6 / 8)
    assert trace.total_bytes == 97_500_000
    assert trace.cumulative_bytes[trace.time_us == 7_500_000].tolist() == [71_250_000]
    # It falls by 0.8 MB/s a second; the last tenth has 0.54 MB/s in the mean, and that is held.
    assert trace.rate_bytes_per_s([14_950_000, 16_000_000]).tolist() == [540_000.0, 540_000.0]
    up, down = ramp(0, 3e6, 3.3), ramp(3e6, 0, 3.3)
    assert np.diff(up.cumulative_bytes).tolist() == np.diff(down.cumulative_bytes).tolist()[::-1]
    trace = steady(7e6, 2.5)
    assert (trace.duration_us, trace.total_bytes) == (2_500_000, 17_500_000)
    assert set(trace.segments()[1].tolist()) == {7e6}
    trace = tunnel(1e6, before_s=1, fade_s=0, blackout_s=2, recover_s=0, after_s=0)
    assert (trace.duration_us, trace.total_bytes) == (3_000_000, 1_000_000)
    # 20 s + 20 s at 10 MB/s, 3 s and 2 s at half of it in the mean, 10 s of nothing.
    trace = tunnel(10e6)
    assert (trace.duration_us, trace.total_bytes) == (55_000_000, 400_000_000 + 25_000_000)
    # The last tenth of 3 s: a sixtieth of the rate, in whole bytes.
    rates = trace.rate_bytes_per_s([22_950_000, 23_000_000, 32_999_999, 33_000_000])
    assert rates == pytest.approx([10e6 / 60, 0.0, 0.0, 10e6 / 40], abs=5)


@given(st.floats(0, 1e9), st.floats(1, 1e9), st.floats(0.001, 50), st.sampled_from(["hold", "stop"]))
def test_a_ramp_carries_its_area(start: float, end: float, seconds: float, after: str) -> None:
    trace = ramp(start, end, seconds, after)  # type: ignore[arg-type]
    area = (start + end) / 2 * trace.duration_us / 1e6
    assert abs(trace.total_bytes - area) <= 0.5 + 1e-9 * area


def test_driving() -> None:
    motion = drive_motion(3, 300)
    assert drive_motion(4, 300).coordinate.tolist() != motion.coordinate.tolist()
    assert motion.duration_us == 300_000_000
    per_s = np.diff(motion.coordinate) * 10
    # At most 60 degrees/s of turning, or 1.5 m/s and 10 degrees/s of cruising; at least 0.5 m/s moving.
    assert per_s.max() <= 1.0 + 1e-5 and per_s[per_s > 1e-6].min() >= 0.25 - 1e-5
    assert 0.02 < (per_s < 1e-6).mean() < 0.4


def test_broken_arguments_and_parameter_files(tmp_path: Path) -> None:
    for make, says in (
        (lambda: markov_link("boat", 0), "mode = 'boat': must be one of bicycle, bus"),
        (lambda: synthetic_lte(-1), "seed = -1: must be >= 0"),
        (lambda: markov_link("bus", 0, 2.5), "duration_s = 2.5: must be a whole number"),  # type: ignore[arg-type]
        (lambda: markov_link("bus", 0, mean_bytes_per_s=float("nan")), "mean_bytes_per_s = nan"),
        (lambda: steady(0), "bytes_per_s = 0: must be a number from 1"),
        (lambda: replace(FLAT, place_share=0.7, level_share=0.7), "level_share = 0.7: must be a number from 0 to 0.3"),
    ):
        refuse(says, make)
    file, shipped = tmp_path / "links.json", LINKS.read_text(encoding="ascii")
    stay = f'"level_stay_s": {json.loads(shipped)["modes"]["bus"]["level_stay_s"]}'
    stays = [shipped.replace(stay, f'"level_stay_s": {s}') for s in ("null", "true", '"5"', "NaN", "-1", "1e400")]
    for text, says in (
        ("{", "must be JSON"),
        ("[]", 'must be an object with "modes"'),
        ('{"modes": {"bus": {"seconds": 5}}}', "mode 'bus': must be an object with fast_memory"),
        ("[" * 100_000, "must be JSON"),
        *((text, "mode '.*': level_stay_s = |numbers must be finite") for text in stays),
    ):
        file.write_text(text, encoding="utf-8")
        refuse(f"links.json.*({says})", read_links, file, kind=TraceError)


# --- files that come with bufgym, and the command ``generate`` -------------------------------------------------------


def test_shipped_names_and_loading(tmp_path: Path) -> None:
    names = traces.shipped()
    assert {f"lte-synthetic-{k}" for k in range(8)} | {"drive-0", "drive-1"} <= set(names)
    assert load_motion("drive-0").name == "drive-0"
    own = tmp_path / "own.csv"
    traces.write_csv(tunnel(), own)
    assert load(own) == load(str(own)) == read_trace(own) and load(own, after="stop").after == "stop"
    refuse(r"lte-nowhere: no such file, .*known: .*drive-0.*lte-synthetic-7", load, "lte-nowhere", kind=TraceError)
    refuse("must fit a known format", load, "drive-0", kind=TraceError)
    refuse("must have 8 columns", read_motion, names["lte-synthetic-0"], kind=TraceError)


GENERATE = ["trace", "generate"]


def test_the_command_writes_traces_and_motion(tmp_path: Path, capsys: Capsys) -> None:
    for arguments in (
        "link --mode train --seed 4 --duration 50 --mean 8e6",
        "ramp --duration 50",
        "tunnel --before 15 --after 20",
    ):
        assert "mean" in shown([*GENERATE, *arguments.split(), "-o", tmp_path / "a.csv"], capsys)
        assert read_trace(tmp_path / "a.csv").duration_us == 50_000_000
    drive = ["drive", "--seed", "1", "--duration", "20", "-o", tmp_path / "m.csv"]
    shown([*GENERATE, *drive], capsys)
    assert read_motion(tmp_path / "m.csv").duration_us == 20_000_000
    fails([*GENERATE, "link", "--mode", "bus", "--links", "no.json", "-o", "x.csv"], "no.json: no such file", capsys)


# Workloads: in and out of CSV files, summed up by topic, and played over a link.

CSV = """time_s,bytes,topic,x
100.5,1000,/camera,2
101.5,500,/odom,2
101.5,1000,/camera,2.25
104.5,1500,/camera,4
"""


def written(folder: Path, text: str) -> Path:
    return link_files.written(folder, text, "w.csv")


def test_a_file_in_full(tmp_path: Path) -> None:
    workload = read_workload(written(tmp_path, CSV))
    assert (workload.name, workload.topics) == ("w", ("/camera", "/odom"))
    assert workload.arrival_us.tolist() == [0, 1_000_000, 1_000_000, 4_000_000]
    assert workload.size_bytes.tolist() == [1000, 500, 1000, 1500]
    assert [workload.topic_of(k) for k in range(4)] == ["/camera", "/odom", "/camera", "/camera"]
    assert workload.x is not None and workload.x.tolist() == [0, 0, 0.25, 2]
    camera, odom = workload.summary()
    # Two intervals in 4 s; 3500 of 4000 bytes.
    assert camera == ("/camera", 3, 0.5, 3500, 0.875)
    assert odom[:2] == ("/odom", 1) and math.isnan(odom.rate_hz) and odom[3:] == (500, 0.125)
    (tmp_path / "w.csv.gz").write_bytes(gzip.compress(CSV.encode()))
    assert read_workload_csv(tmp_path / "w.csv.gz").arrival_us.tolist() == workload.arrival_us.tolist()
    least = read_workload_csv(written(tmp_path, "time_s,bytes\n0,1\n0.000001,2\n"))
    assert least.arrival_us.tolist() == [0, 1] and least.topics == ("",) and least.x is None
    # The clock and x begin with the first message chosen.
    path = written(tmp_path, CSV + "105.5,7,/imu,5\n")
    late = read_workload(path, topics=["/odom", "/i*"])
    assert late.arrival_us.tolist() == [0, 4_000_000] and late.size_bytes.tolist() == [500, 7]
    assert late.x is not None and late.x.tolist() == [0, 3] and late.topic_of(1) == "/imu"
    refuse(r"no topic '/lidar'; it has: /camera, /odom", read_workload, path, topics=["/lidar"])
    refuse(r"odom = '/odom': needs a recording, which this is not", read_workload, path, odom="/odom")


MESSAGES = st.tuples(st.integers(0, 10**9), st.integers(1, 10**10), st.integers(0, 2), st.floats(0, 1e6))


@pytest.mark.filterwarnings("ignore:.*no message for:bufgym.utils.errors.TraceWarning")
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(messages=st.lists(MESSAGES, min_size=1), names=st.booleans(), moves=st.booleans())
def test_a_round_trip(tmp_path: Path, messages: list[tuple[int, int, int, float]], names: bool, moves: bool) -> None:
    steps_us, sizes, topics, steps = (np.array(column) for column in zip(*messages, strict=True))
    moved, time_us = np.cumsum(steps), np.cumsum(steps_us)
    topic, called = (topics, ("/a", "/b c", "/ü")) if names else (None, ("",))
    workload = Workload("w", time_us - time_us[0], sizes, topic, called, moved - moved[0] if moves else None)
    write_workload_csv(workload, tmp_path / "w.csv")
    again = read_workload_csv(tmp_path / "w.csv")
    assert again.arrival_us.tolist() == workload.arrival_us.tolist() and again.size_bytes.tolist() == sizes.tolist()
    assert [again.topic_of(k) for k in range(len(again))] == [workload.topic_of(k) for k in range(len(again))]
    assert np.array_equal(again.x, workload.x) if moves else again.x is None


def test_broken_files(tmp_path: Path) -> None:
    for text, says in (
        ("", "w.csv: is empty: must begin with the header time_s,bytes"),
        ("time_s,bytes\n", "w.csv: holds no message: must hold at least one"),
        ("time_s,bytes\n1,0\n", "line 2: bytes = 0: must be at least 1"),
        ("time_s,bytes\n1,99999999999\n", "line 2: bytes = 99999999999: must be at most 10000000000"),
        ("time_s,bytes\n1,1\n2e7,1\n", "line 3: time_s = 2e7: must be at most 10000000 s after the first"),
        ("time_s,bytes,topic\n1,1,\n", "line 2: topic = '': must not be empty"),
        ("time_s,bytes,x\n1,1,1\n2,1,0.5\n", "line 3: x = 0.5: must not be below the line above"),
    ):
        refuse(says, read_workload, written(tmp_path, text), kind=TraceError)


def test_broken_arrays_and_names_that_a_csv_file_cannot_hold(tmp_path: Path) -> None:
    time_us, size = np.array([0, 5]), np.array([1, 1])
    for arguments, says in (
        ((np.array([1, 5]), size), "arrival_us must begin with 0"),
        ((time_us, np.array([1])), "size_bytes must be int64"),
        ((time_us, np.array([1, 0])), "size_bytes must lie between 1"),
        ((time_us[:0], size[:0]), "at least one message"),
        ((time_us, size, None, ("",), np.array([0, -1.0])), "x must be .* not decrease"),
    ):
        refuse(f"workload 'w': .*{says}", Workload, "w", *arguments)
    for name in ("a,b", " a", "", "a\nb"):
        workload = Workload("w", np.array([0]), np.array([1]), np.array([0]), (name, "other"))
        refuse("a name in a CSV file must be printable", write_workload_csv, workload, tmp_path / "w.csv")
    with pytest.raises(TraceError, match="cannot be written"):
        write_workload_csv(Workload("w", np.array([0]), np.array([1])), tmp_path / "nowhere" / "w.csv")


NOTHING = Trace("outage", np.array([0, 4_000_000, 5_000_000]), np.array([0, 0, 10_000]), "hold")
"""For four seconds."""


def recorded(sizes: tuple[int, ...] = (1000, 1000, 1000, 1000)) -> Workload:
    """A message a second, on two topics in turn; the scene moves on in the second and third second only."""
    time_us, x = np.arange(4) * 1_000_000, np.array([0.0, 0.0, 1.0, 2.0])
    return Workload("drive", time_us, np.array(sizes), np.array([0, 1, 0, 1]), ("/camera", "/odom"), x)


def uplink(workload: Workload, **other: object) -> scenario.Uplink:
    fixed = {"traces": (NOTHING,), "random_offset": False, "propagation_us": 0}
    return scenario.Uplink(workload=workload, **fixed, **other)  # type: ignore[arg-type]


@pytest.mark.kernels
def test_the_drops_of_a_recording() -> None:
    """L = 1 and nothing crosses for 4 s: message 0 is in transmission, 1 waits, 2 and 3 find the buffer full."""
    chosen = [policies.get(name) for name in ("drop-oldest", "drop-newest")]
    dropped = list(drops.drops(chosen, uplink(recorded()), [1, 2], 1))
    assert [(d.policy, d.capacity, d.message, d.time_s, d.topic, d.x, d.dropped_s) for d in dropped] == [
        ("drop-oldest", 1, 1, 1.0, "/odom", 0.0, 2.0),
        ("drop-oldest", 1, 2, 2.0, "/camera", 1.0, 3.0),
        ("drop-newest", 1, 2, 2.0, "/camera", 1.0, 2.0),
        ("drop-newest", 1, 3, 3.0, "/odom", 2.0, 3.0),
        ("drop-oldest", 2, 1, 1.0, "/odom", 0.0, 3.0),
        ("drop-newest", 2, 3, 3.0, "/odom", 2.0, 3.0),
    ]
    refuse("must play a recording", list, drops.drops(chosen, scenario.Uplink(traces=(NOTHING,)), [1], 1))


def test_an_episode_is_the_recording_with_x_of_its_own_or_from_elsewhere_or_from_the_number() -> None:
    stream, streams = uplink(recorded((1, 2, 3, 4))), scenario.Streams.seeded(3)
    episode = stream.draw(streams)
    assert (stream.max_messages, episode.link.offset_us) == (4, 0)
    columns = (episode.arrivals[name].tolist() for name in ("arrival_us", "size_bytes", "topic", "x"))
    rows = [(0, 1, 0, 0), (1_000_000, 2, 1, 0), (2_000_000, 3, 0, 1), (3_000_000, 4, 1, 2)]
    assert list(zip(*columns, strict=True)) == rows
    silent = Workload("w", np.array([0, 500_000, 1_000_000]), np.array([1, 1, 1]))
    motion = Motion("m", np.array([0, 1_000_000]), np.array([0.0, 3.0]))
    assert uplink(silent).draw(streams).arrivals["x"].tolist() == [0, 1, 2]
    assert uplink(silent, motion=(motion,)).draw(streams).arrivals["x"].tolist() == [0, 1.5, 3]
    refuse("workload 'drive' has an x of its own", uplink, recorded(), motion=(motion,))

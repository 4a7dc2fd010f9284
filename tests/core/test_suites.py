"""The suites: every split builds, splits share nothing, and no embedded suite changes unnoticed."""

import gzip
import hashlib
import re
from pathlib import Path

import numpy as np
import pytest
from refusal_cases import refuse

from bufgym.benchmark.sweep import Sweep
from bufgym.scenario import Interruption, Uplink, suites
from bufgym.scenario.numbered import draw
from bufgym.utils.errors import BufgymError

EMBEDDED = [name for name, suite in suites.SUITES.items() if suite.kind in ("queue", "stress") and not suite.needs]
RECORDED = [name for name, suite in suites.SUITES.items() if suite.needs]

PINNED = {
    "interruption-v1": "81ace5d19b6564e7",
    "lte-v1": "1dffd441e1f65364",
    "outage-v1": "72a3f5dd0a7c1cfc",
    "sustained-v1": "48007a14e04b0270",
    "generated-v1": "bfa3d1381410f166",
    "lte-v2": "72a00fc946ca3b3c",
    "generated-v2": "5b1268420f2f1a12",
    "jpeg-v1": "320eb578731b8f31",
    "switching-v1": "c970a9db24bc3b5a",
    "stress-v1": "c2de3821b0b1fd20",
}
"""SHA-256 of all episodes of the test split. A suite is frozen: whoever wants another makes the next version."""


def scenarios(name: str, split: str, data: Path | None = None) -> dict[str, Interruption | Uplink]:
    found = {}
    for label, setting in suites.get(name).settings(split, data).items():
        assert isinstance(setting.scenario, Interruption | Uplink)
        found[label] = setting.scenario
    return found


def used(scenario: Interruption | Uplink) -> set[tuple[str, object]]:
    """All that a policy could know by heart: names and contents of traces and motions, or the lengths."""
    if isinstance(scenario, Interruption):
        return {("T", T) for T in scenario.lengths}
    contents = [t.time_us.tobytes() + t.cumulative_bytes.tobytes() for t in scenario.traces]
    contents += [m.time_us.tobytes() + m.coordinate.tobytes() for m in scenario.motion]
    names = [trace.name for trace in scenario.traces] + [motion.name for motion in scenario.motion]
    return {("content", each) for each in contents} | {("name", name) for name in names}


@pytest.mark.filterwarnings("ignore:.*is held:bufgym.utils.errors.TraceWarning")  # holes of recordings
@pytest.mark.parametrize("name", [*EMBEDDED, *(pytest.param(name, marks=pytest.mark.nightly) for name in RECORDED)])
def test_a_suite_builds_every_split_and_splits_share_nothing(name: str, request: pytest.FixtureRequest) -> None:
    data = request.getfixturevalue("shared_data") if name in RECORDED else None
    suite = suites.get(name)
    assert suite.name == name and suite.about and name[-1].isdigit()
    assert len(set(suite.capacities)) == len(suite.capacities) and min(suite.capacities) >= 1
    known: dict[str, set[tuple[str, object]]] = {}
    labels = []
    for split in suites.SPLITS:
        built = scenarios(name, split, data)
        labels.append(list(built))
        known[split] = set().union(*(used(scenario) for scenario in built.values()))
        for label, scenario in built.items():
            settings = suite.settings(split, data)
            assert settings[label].about and (settings[label].outage_s is None) == ("outage" not in label)
            if isinstance(scenario, Uplink):
                assert scenario.size_cv == 0
                names = [trace.name for trace in scenario.traces]
                assert len(set(names)) == len(names)
            equal = getattr(scenario, "sizes", "equal") == "equal"  # otherwise the bound is not exact
            assert (len(set(draw(scenario, 0).arrivals["size_bytes"])) == 1) == equal
            assert equal or name == "jpeg-v1"
    assert labels[0] == labels[1] == labels[2]
    for one, other in (("train", "validation"), ("train", "test"), ("validation", "test")):
        assert known[one] and not known[one] & known[other], (one, other)


@pytest.mark.nightly
def test_5g_uplinks_are_split_by_day_without_the_runs_that_failed(shared_data: Path) -> None:
    counts = {}
    for split, days in (("train", "123"), ("validation", "4"), ("test", "5")):
        built = scenarios("uplink-5g-v1", split, shared_data)
        assert list(built) == ["time-230kB", "motion-230kB", "time-900kB", "motion-900kB"]
        (names,) = {tuple(trace.name for trace in s.traces) for s in built.values() if isinstance(s, Uplink)}
        assert {name[:8] for name in names} == {f"2024110{day}" for day in days}
        counts[split] = len(names)
    assert counts == {"train": 24, "validation": 6, "test": 12}


@pytest.mark.nightly
def test_wifi_and_mmwave_uplinks_are_split_by_place(shared_data: Path) -> None:
    for split, place, spot in (("train", "loc2", "p1"), ("validation", "loc1", "p2"), ("test", "loc3", "p3")):
        wifi = scenarios("uplink-wifi-v1", split, shared_data)["motion-900kB"]
        assert isinstance(wifi, Uplink) and all(f"_{place}_" in trace.name for trace in wifi.traces)
        mmwave = scenarios("uplink-mmwave-v1", split, shared_data)["motion-900kB"]
        assert isinstance(mmwave, Uplink)
        ways = {trace.name.rpartition("-")[0].split("_5g_")[1] for trace in mmwave.traces}
        assert ways > {f"away_{spot}", f"toward_{spot}"} and len(ways) == 3


@pytest.mark.parametrize("name", EMBEDDED)
def test_an_embedded_suite_is_frozen(name: str) -> None:
    assert fingerprint(name) == PINNED[name], "a suite never changes; give what is better the next version"


def fingerprint(name: str) -> str:
    """SHA-256 over every episode of the test split, as the benchmark draws them."""
    digest = hashlib.sha256()
    sweep = Sweep(name, ("afr",)).checked()
    for shard in sweep.shards():
        part = sweep.setting(shard.label, shard.trace).scenario
        digest.update(f"{shard.label} {shard.trace} {part.value.name}".encode())
        for seed in shard.seeds:
            episode = draw(part, seed)
            # In steps of 1e-9: interpolation may differ in the last bit elsewhere. x often ends in ...5 in the tenth
            # decimal, so the edges of the steps are moved away from there.
            x = np.floor(episode.arrivals["x"] * 1e9 + 0.5034).astype(np.int64)
            uniform = np.floor(episode.arrivals["uniform"] * 1e9).astype(np.int64)
            knots = (episode.link.trace.time_us, episode.link.trace.cumulative_bytes)
            for column in (episode.arrivals["arrival_us"], episode.arrivals["size_bytes"], x, uniform, *knots):
                digest.update(np.ascontiguousarray(column, "<i8").tobytes())
            whole = (episode.link.offset_us, episode.link.propagation_us, episode.first_decision, episode.last_decision)
            digest.update(f"{seed} {whole} {episode.link.trace.after}".encode())
    return digest.hexdigest()[:16]


def test_what_is_unknown_or_missing_is_named(tmp_path: Path) -> None:
    refuse(r"unknown suite 'outage-v0'; did you mean 'outage-v1'\?", suites.get, "outage-v0")
    refuse(r"split = 'tests': must be one of train, validation, test", suites.get("lte-v1").settings, "tests")
    for name in RECORDED:
        fault = rf"suite {name} needs a folder of recordings \(--data DIR\) with .*{re.escape(suites.get(name).needs)}"
        refuse(fault, suites.get(name).settings, "test")
        refuse(str(tmp_path / "nowhere"), suites.get(name).settings, "test", tmp_path / "nowhere")
    (tmp_path / "mahimahi").mkdir()
    for k in range(5):
        with gzip.open(tmp_path / f"mahimahi/link-{k}.down.gz", "wt") as file:
            file.write("1\n2\n1000\n")
    with pytest.raises(BufgymError, match=r"tum_rgbd/freiburg1_rpy\.groundtruth\.txt\.gz: no such file"):
        suites.get("mahimahi-v1").settings("test", tmp_path)
    (tmp_path / "mahimahi/link-4.down.gz").unlink()
    refuse(r"holds 4 recordings; this suite needs at least 5", suites.get("mahimahi-v1").settings, "test", tmp_path)

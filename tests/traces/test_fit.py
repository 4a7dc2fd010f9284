"""The fit recovers the generator's parameters."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_cases import Capsys, Patch, fails, shown
from fit_cases import KNOWN
from refusal_cases import refuse

from bufgym.scenario import suites
from bufgym.scenario.suites.synthetic import both_values
from bufgym.traces import markov_link, read_links, read_trace, write_csv
from bufgym.traces.fit import autocorrelation, fit_links, mode_of, spells
from bufgym.traces.generate.markov import link_rates
from bufgym.traces.generate.parameters import LINKS, UPLINKS, LinkParameters
from bufgym.traces.trace import US_PER_S, Float64Array


def recordings(link: LinkParameters = KNOWN) -> list[Float64Array]:
    return [link_rates(link, seed, link.seconds // link.recordings) for seed in range(link.recordings)]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Fits try each memory on some hundred seconds only; nightly ones on all."""
    if request.node.get_closest_marker("nightly") is None:
        monkeypatch.setattr("bufgym.traces.fit._TRIAL_S", 500)


@pytest.mark.nightly
def test_the_fit_recovers_the_parameters_of_the_generator() -> None:
    fitted = fit_links({"known": recordings()})["known"]
    assert (fitted.recordings, fitted.seconds) == (20, 12_000)
    # Quantiles within a tenth; the outer ones within a fifth, but for that of 1 %, which few of some 400 levels reach.
    wrong = np.abs(np.array(fitted.quantiles_bytes_per_s) / np.array(KNOWN.quantiles_bytes_per_s) - 1)
    assert wrong[3:-3].max() < 0.1
    assert np.delete(wrong, 1).max() < 0.2
    assert 0.55 <= fitted.place_share + fitted.level_share <= 0.85
    assert 14 <= fitted.level_stay_s <= 56
    assert fitted.fast_memory <= 0.6
    outages = fitted.outages
    assert outages is not None and outages.spells > 100
    assert 0.3 <= outages.short_gap_share <= 0.7 and 3 <= outages.short_gap_s <= 9
    assert 0.4 <= outages.shoulder <= 0.6 and 80 <= outages.long_gap_s <= 180
    # P(over 3 s) = (1 + 3 / 4)**-3 = 0.19
    assert abs((1 + 3 / outages.length_scale_s) ** -outages.length_tail - 0.19) < 0.06


def test_fits_of_few_seconds() -> None:
    """A mode with few outages borrows from the others; without any it has none; recordings that differ have a place."""
    calm = [np.full(300, 2e6) for _ in range(3)]
    calm[0][100:102] = 1e5
    known = recordings(replace(KNOWN, recordings=4, seconds=2400))
    links = fit_links({"calm": calm, "known": known, "still": [np.full(300, 2e6)]})
    assert links == fit_links({"calm": calm, "known": known, "still": [np.full(300, 2e6)]})
    lent, own = links["known"].outages, links["calm"].outages
    assert lent is not None and own is not None
    assert (own.spells, own.borrowed, lent.borrowed, own.short_gap_share) == (1, True, False, 0)
    assert own.long_gap_s == 898  # one outage in 898 s outside of it
    assert fit_links({"calm": [np.full(300, 2e6)]})["calm"].outages is None
    rows = [row / 2 + 4e6 * (k % 2) for k, row in enumerate(recordings(replace(KNOWN, outages=None)))]
    assert fit_links({"two": rows})["two"].place_share >= 0.3


def test_statistics_by_hand() -> None:
    starts, ends = spells(np.array([1e5, 2e6, 0.0, 4e5, 5e5]))
    assert (starts.tolist(), ends.tolist()) == ([0, 2], [1, 4])
    # 1, -1, 1, -1 about 0: products at lag 1 are all -1, at lag 2 all 1, the variance is 1; no pair at lag 9.
    correlations, pairs = autocorrelation([np.array([1.0, -1.0, 1.0, -1.0])], (1, 2, 9))
    assert (correlations.tolist(), pairs.tolist()) == ([-1.0, 1.0, 0.0], [3, 2, 0])


def test_what_the_fit_refuses(tmp_path: Path, capsys: Capsys) -> None:
    for wrong, says in (
        ({}, "no recordings"),
        ({"slow": [np.full(100, 1e5)]}, "mode slow: 0 of 100 s have 500000 bytes/s or more: must be at least 60"),
        ({"nan": [np.full(100, np.nan)]}, "mode nan: rates must be finite"),
        ({"negative": [np.full(100, -1.0)]}, "mode negative: rates must be finite and >= 0"),
    ):
        refuse(says, fit_links, wrong)
    names = ("report_car_0002.csv", "logs/wifi_office_231114-151821.txt", "Tram.csv", "report_bus_0001.csv.gz")
    assert [mode_of(name) for name in names] == ["car", "wifi-office", "tram", "bus"]
    refuse(r"0001.csv: its name does not say the mode: give --mode", mode_of, "0001.csv")
    for words, says in (
        ("", "needs recordings, FILE ... or --suite NAME"),
        ("a.csv --suite lte-v1", "--suite: cannot go with FILE or --mode"),
        ("a.csv --data .", "--data: needs --suite"),
    ):
        fails(["trace", "fit", *words.split(), "-o", tmp_path / "b.json"], says, capsys)
    assert not (tmp_path / "b.json").exists()


def test_the_command_writes_parameters(tmp_path: Path, capsys: Capsys) -> None:
    files = [str(tmp_path / f"report_known_{seed}.csv") for seed in range(3)]
    for seed, file in enumerate(files):
        write_csv(markov_link("known", seed, 200, links={"known": KNOWN}), file)
    out = tmp_path / "links.json"
    fit = ["trace", "fit", "-o", out]
    assert "3 recordings" in shown([*fit, *files[::-1]], capsys)
    fitted = read_links(out)
    assert str(tmp_path) not in out.read_text()
    shown([*fit, *files], capsys)  # in any order
    assert read_links(out) == fitted and fitted["known"].seconds == 600
    shown([*fit, *files, "--mode", "walk"], capsys)
    assert list(read_links(out)) == ["walk"]


def test_the_command_fits_what_a_suite_trains_on(monkeypatch: Patch, tmp_path: Path, capsys: Capsys) -> None:
    """The links of the train split alone, each once though it carries several scenarios."""

    def build(split: str, data: Path | None) -> dict[str, suites.Setting]:
        traces = [markov_link("known", seed, 100, links={"known": KNOWN}) for seed in range(1 + (split == "train"))]
        return both_values(traces, ())

    monkeypatch.setitem(suites.SUITES, "two-v7", suites.Suite("two-v7", "two links", build))
    shown(["trace", "fit", "--suite", "two-v7", "-o", tmp_path / "two.json"], capsys)
    ((mode, link),) = read_links(tmp_path / "two.json").items()
    assert (mode, link.recordings, link.seconds) == ("two", 2, 200)
    assert '"made_by": "bufgym trace fit --suite two-v7 -o two.json"' in (tmp_path / "two.json").read_text()


@pytest.mark.nightly
def test_the_committed_parameters_fit_the_recordings(shared_data: Path, tmp_path: Path, capsys: Capsys) -> None:
    rows: dict[str, list[Float64Array]] = {}
    for file in sorted([*shared_data.glob("belgium_4g/csv/*.csv"), *shared_data.glob("solis_wifi/wifi_*.txt")]):
        rows.setdefault(mode_of(file), []).append(read_trace(file).samples(US_PER_S)[1])
    assert fit_links(rows) == read_links(LINKS)
    names = "uplink-5g-v1,uplink-wifi-v1,uplink-mmwave-v1"
    shown(["trace", "fit", "--suite", names, "--data", shared_data, "-o", tmp_path / "uplinks.json"], capsys)
    assert (tmp_path / "uplinks.json").read_bytes() == UPLINKS.read_bytes()

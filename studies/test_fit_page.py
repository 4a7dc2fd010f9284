"""The comparison of generated links with recordings tells a link from others, and its page is written."""

from dataclasses import replace
from pathlib import Path

import fit_cases
import numpy as np
import pytest
from needs import needs

from bufgym.traces import markov_link, write_csv
from bufgym.traces.generate.markov import link_rates
from bufgym.traces.generate.parameters import write_links
from studies.compare_links import compare, held_out, ks_distance
from studies.fit import main as write_page

KNOWN = replace(fit_cases.KNOWN, recordings=5, seconds=1500)


def test_the_distance_by_hand() -> None:
    """Of 1, 2 none is above 2; of 2, 3, 4, 5 three are: distance 3/4."""
    assert ks_distance(np.array([1.0, 2.0]), np.array([2.0, 3.0, 4.0, 5.0])) == 0.75
    assert ks_distance(np.array([1.0, 2.0]), np.array([1.0, 2.0])) == 0.0


def test_the_comparison_accepts_the_link_itself_and_refuses_one_without_memory() -> None:
    assert 0 < held_out("one", [link_rates(KNOWN, 1, 600)], sets=9).distance < 1
    rows = [link_rates(KNOWN, 77 + seed, 300) for seed in range(5)]
    own = {row.name: row.p for row in compare(KNOWN, rows, sets=59)}
    assert sum(p < 0.05 for p in own.values()) <= 2
    no_memory = replace(KNOWN, place_share=0.0, level_share=0.0, fast_memory=0.0, outages=None)
    other = {row.name: row.p for row in compare(no_memory, rows, sets=59)}
    for name in ("autocorrelation at 1 s", "autocorrelation at 5 s", "seconds under 500 KB/s, %", "outages an hour"):
        assert other[name] < 0.05


def test_the_page_has_its_tables_and_pictures(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason=needs("extras", "matplotlib"))
    files = [str(tmp_path / f"report_known_{seed}.csv") for seed in range(3)]
    for seed, file in enumerate(files):
        write_csv(markov_link("known", seed, 200, links={"known": KNOWN}), file)
    links, page, figure = tmp_path / "links.json", tmp_path / "page.md", tmp_path / "figures" / "link-known.svg"
    write_links({"known": replace(KNOWN, recordings=3, seconds=600)}, links, 5e5, "by hand")
    write_page(links, page, *files, sets=9)
    text = page.read_text()
    assert "| autocorrelation at 30 s |" in text and str(tmp_path) not in text
    assert "![known: recordings and generated links](figures/link-known.svg)" in text and figure.exists()

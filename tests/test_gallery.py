"""The gallery: films show what the simulator says, and the interactive page holds bufgym's own numbers."""

from pathlib import Path

import pytest
from browser_cases import embedded, opened

from bufgym.envs.render.scene import DELIVERED, DROPPED, QUEUED, SENDING
from bufgym.scenario import Interruption
from bufgym.scenario.numbered import draw
from website import films, picture

REPO = Path(__file__).resolve().parent.parent
FILMS = REPO / "docs" / "gallery"
MAX_ALL_BYTES = 2_000_000


def test_an_interruption_second_by_second() -> None:
    """T = 4, L = 2 under Drop Oldest: 3 evicts 1, 4 evicts 2; the link returns half a period after 4."""
    scenario = Interruption(law="fixed", t_max=4, rate_hz=10)
    (run,) = picture.play(["drop-oldest"], draw(scenario, 0), 2, scenario)
    assert run.received.tolist() == [0, 3, 4, 5]
    assert picture.states_at(run, 250_000).tolist() == [SENDING, QUEUED, QUEUED, -1, -1, -1]
    assert picture.states_at(run, 300_000).tolist() == [SENDING, DROPPED, QUEUED, QUEUED, -1, -1]
    assert picture.states_at(run, 900_000).tolist() == [DELIVERED, DROPPED, DROPPED, DELIVERED, DELIVERED, DELIVERED]
    assert run.longest_gap_s == pytest.approx(0.3)
    # Gaps of 3, 1 and 1 with V = 1 - 0.618^d.
    assert run.h == pytest.approx(1 + (1 - 0.618**3) + 2 * (1 - 0.618))


def test_the_films_in_docs_are_small_and_all_there() -> None:
    sizes = {path.stem: path.stat().st_size for path in FILMS.glob("*.webp")}
    assert set(sizes) == set(films.FILMS)
    assert max(sizes.values()) < films.MAX_BYTES
    assert sum(sizes.values()) < MAX_ALL_BYTES


@pytest.mark.nightly
def test_the_page_is_what_the_command_writes(tmp_path: Path) -> None:
    films.main(["--interactive", str(tmp_path / "page.html")])
    assert (tmp_path / "page.html").read_text() == (REPO / "docs" / "interactive.html").read_text()


@pytest.mark.nightly
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_shows_them(scheme: str) -> None:
    interactive = REPO / "docs" / "interactive.html"
    data = embedded(interactive.read_text(encoding="utf-8"), r"^const data = (\{.*\});$")
    with opened(interactive, scheme, 390) as page:
        page.check("input[name=L][value='4']")
        page.fill("#length", "37")
        shown = page.eval_on_selector_all(".run[data-policy]", ROWS)
        assert not page.is_visible("#link")
        page.check("input[value=link]")
        page.select_option("#link", "lte-synthetic-5")
        over_link = page.eval_on_selector_all(".run[data-policy]", ROWS)
        assert not page.is_visible("#length")
    runs = data["interruptions"]["4"]
    assert shown == [[p, f"{run['h'][36]:.3f}", [0, *run["kept"][36], 38]] for p, run in runs.items()]
    link = data["links"]["lte-synthetic-5"]["runs"]
    assert [[p, h, f"{sum(1 << k for k in received):x}"] for p, h, received in over_link] == [
        [p, f"{run['h']:.3f}", run["received"]] for p, run in link.items()
    ]


ROWS = """rows => rows.map(row => [row.dataset.policy, row.querySelector(".h").firstChild.textContent.trim().slice(4),
    row.dataset.received.split(" ").map(Number)])"""

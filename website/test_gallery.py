"""The interactive page holds bufgym's own numbers."""

from pathlib import Path

import pytest
from browser_cases import embedded, opened

from website import films

REPO = Path(__file__).resolve().parent.parent


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

"""The page over robots that were here before it was opened."""

import json
import time
from pathlib import Path

import pytest
from browser_cases import browsing, shows
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from page_cases import Fleet  # noqa: E402
from relay_cases import settings  # noqa: E402
from test_page import until  # noqa: E402
from test_page_fleet import PLACE, WIDTHS, text  # noqa: E402

from bufgym_relay.audit import Audit  # noqa: E402
from bufgym_relay.store import Store  # noqa: E402

pytestmark = compiled


@pytest.mark.parametrize("width", WIDTHS)
def test_robots_that_are_away_are_listed_until_they_are_removed(width: int, tmp_path: Path) -> None:
    """They stand under those that are here, with their last place. On a phone 60 of them are a list that scrolls."""
    said, long_us = json.dumps({"text": "charges", "location": PLACE}), time.time_ns() // 1000 - 3 * 3600 * 10**6
    rows = [(name, long_us, said) for name in ("g\u043e\u043ed", *(f"old-{k}" for k in range(60)))]
    kept = settings(folder=tmp_path)
    store = Store(kept, Audit(None, kept.audit), lambda _: None, time.monotonic)
    store.keep_robots(rows, 100)
    store.close()
    with (
        browsing() as browser,
        Fleet(folder=tmp_path) as fleet,
        shows(browser, f"http://127.0.0.1:{fleet.port}/", width=width) as page,
    ):
        fleet.robots["zebra"] = {"location": PLACE}, ()
        until(page, f"{text('#count')} === '1, 61 away'", f"{text('#name')} === 'zebra'")
        names = text(".called")
        assert page.evaluate(names).startswith("zebra,") and page.is_hidden("#remove")
        assert page.evaluate(text(".mark:not([hidden])")) == "unusual letters"
        assert page.evaluate("document.querySelector('#robots').offsetHeight <= 800")
        page.fill("#search", "old-59")
        page.click(".card:not([hidden])")
        assert page.evaluate(text(".card:not([hidden]) .seen")) == "last seen 3 h ago at 0.0, 0.0 m"
        page.click("#remove")
        until(page, f"!{names}.includes('old-59')", f"{text('#name')} === 'zebra'")
        page.reload()
        until(page, f"{text('#count')} === '1, 60 away'")
        assert "old-59" not in page.evaluate(names)

"""Pages: their data, and in a real browser all that they say and ask for."""

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from needs import needs

QUIET = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
QUIET += ["--disable-component-update", "--disable-sync"]


def embedded(page: str, pattern: str) -> Any:
    """The data in a page's text, of which nothing ends its script."""
    (found,) = re.findall(pattern, page, re.MULTILINE)
    assert "<" not in found
    return json.loads(found)


@contextmanager
def browsing() -> Iterator[Any]:
    """A browser; skips where there is none."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip(needs("browser", "no chromium"))
    playwright = pytest.importorskip("playwright.sync_api", reason=needs("extras", "playwright.sync_api"))
    with playwright.sync_playwright() as play, play.chromium.launch(executable_path=chromium, args=QUIET) as browser:
        yield browser


@contextmanager
def shows(browser: Any, address: str, scheme: str = "light", width: int = 1360) -> Iterator[Any]:
    """The page at an address; it must complain of nothing, load nothing from elsewhere, and fit the window's width."""
    page = browser.new_page(color_scheme=scheme, viewport={"width": width, "height": 800})
    said: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(address)
    yield page
    assert page.evaluate("document.documentElement.scrollWidth") == width
    page.close()
    looked = ("willReadFrequently", "GPU stall due to ReadPixels")  # said of what reads a canvas here
    assert [text for text in said if not any(what in text for what in looked)] == []
    from_here = address.partition("#")[0], "data:", "blob:"
    assert [url for url in asked if not url.startswith(from_here)] == []


@contextmanager
def opened(file: Path, scheme: str, width: int) -> Iterator[Any]:
    """The page of a file."""
    with browsing() as browser, shows(browser, file.as_uri(), scheme, width) as page:
        yield page

"""The page in a browser: robots, map, senses, queue, a command, a recording; on a desk and on a phone."""

import asyncio
import queue
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from loop_cases import compiled

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=f"no {library} here: the extra relay")

from bufgym.relay import demo  # noqa: E402

CHROMIUM = shutil.which("chromium")
pytestmark = [compiled, pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")]

SEES = """canvas => {
  const seen = new Set();
  const {data} = canvas.getContext("2d", {willReadFrequently: true}).getImageData(0, 0, canvas.width, canvas.height);
  for (let k = 0; k < data.length; k += 4)
    if (data[k + 3]) seen.add(data[k] >> 4 << 8 | data[k + 1] >> 4 << 4 | data[k + 2] >> 4);
  return seen.size;
}"""
"""How many colours a canvas has."""


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Of a relay with two made-up robots, in a thread; it records."""
    found: queue.Queue[int] = queue.Queue()
    over = threading.Event()

    async def show(folder: Path) -> None:
        async with demo.running(2, policy="drop-oldest", fades=False, folder=folder) as number:
            found.put(number)
            await asyncio.to_thread(over.wait)

    thread = threading.Thread(target=lambda: asyncio.run(show(tmp_path_factory.mktemp("relay"))))
    thread.start()
    yield found.get()
    over.set()
    thread.join()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as play:
        one = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield one
        one.close()


class Page:
    """A page, and what went wrong on it."""

    def __init__(self, browser: Any, port: int, **options: Any) -> None:
        self.page = browser.new_page(**options)
        self.faults: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", self._hear)
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(f"http://127.0.0.1:{port}/")

    def _hear(self, message: Any) -> None:
        if "willReadFrequently" not in message.text:  # said of ``SEES``, not of the page
            self.faults.append(message.text)

    def until(self, expression: str) -> None:
        """Wait until this holds on the page."""
        for _ in range(6_000):  # the page's own rules forbid it to wait for text that is evaluated there
            assert not self.faults, expression
            if self.page.evaluate(expression):
                return
            self.page.wait_for_timeout(20)
        pytest.fail(f"never {expression}")

    def sees(self, canvas: str, colours: int) -> None:
        """Wait until the canvas has so many."""
        self.until(f"({SEES})(document.querySelector('{canvas}')) >= {colours}")

    def close(self) -> None:
        assert self.faults == []
        self.page.close()


@pytest.mark.parametrize(("scheme", "width"), [("light", 1360), pytest.param("dark", 390, marks=pytest.mark.nightly)])
def test_it_shows_the_robots(browser: Any, port: int, scheme: str, width: int) -> None:
    shown = Page(browser, port, color_scheme=scheme, viewport={"width": width, "height": 800})
    shown.until("document.querySelectorAll('.card').length === 2")
    shown.until("document.querySelector('#camera-says').textContent.startsWith('camera')")
    shown.until("document.querySelector('#scan-says').textContent.startsWith('laser')")
    shown.until("document.querySelectorAll('#topics tr').length === 5")
    names = shown.page.eval_on_selector_all(".card b", "cards => cards.map(card => card.textContent)")
    assert names == ["robot-1", "robot-2"]
    shown.page.click(".card:nth-of-type(2)")
    shown.until("document.querySelector('#name').textContent === 'robot-2'")
    shown.until("document.querySelector('#facts').textContent.includes('battery')")
    for canvas, colours in (("#camera", 20), ("#scan", 3), ("#map", 5), ("#slots", 1)):
        shown.sees(canvas, colours)
    assert shown.page.text_content("#state") == "live"
    assert shown.page.evaluate("document.documentElement.scrollWidth") <= width
    assert all(f"127.0.0.1:{port}/" in url or url.startswith(("data:", "blob:")) for url in shown.asked)
    shown.close()


@pytest.mark.nightly
def test_a_viewer_chooses_the_policy_and_plays_a_recording(browser: Any, port: int) -> None:
    shown = Page(browser, port)
    cards = "document.querySelectorAll('.card').length === 2"
    shown.until(f"{cards} && document.querySelector('#policy').value === 'drop-oldest'")
    shown.page.select_option("#policy", "drop-newest")
    shown.until("document.querySelector('#told').textContent === ''")
    assert shown.page.input_value("#policy") == "drop-newest"
    shown.page.click("#recordings")
    shown.page.click("#files li button")
    shown.until(f"{cards} && document.querySelector('#clock').textContent !== ''")
    shown.until("document.querySelector('#camera-says').textContent.startsWith('camera')")
    assert shown.page.text_content("#state") == "replay" and shown.page.is_disabled("#policy")
    shown.page.click("#play")
    assert shown.page.text_content("#play") == "Play"
    shown.page.click("#live")
    shown.until(f"document.querySelector('#state').textContent === 'live' && {cards}")
    shown.close()

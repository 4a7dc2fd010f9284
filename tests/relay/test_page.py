"""The page in a browser: robots, map, senses, queue, a command, a recording; on a desk and on a phone."""

import asyncio
import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser_cases import browsing, shows
from loop_cases import compiled

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=f"no {library} here: the extra relay")

import fleet_demo as demo  # noqa: E402

pytestmark = compiled

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
            await asyncio.to_thread(over.wait, 600)

    thread = threading.Thread(target=lambda: asyncio.run(show(tmp_path_factory.mktemp("relay"))))
    thread.start()
    yield found.get(timeout=120)
    over.set()
    thread.join(120)
    assert not thread.is_alive(), "waited 120 s for the relay's end"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with browsing() as one:
        yield one


def until(page: Any, *expressions: str) -> None:
    """Wait until these have held on the page, one after the other."""
    for expression in expressions:
        for _ in range(6_000):  # the page's own rules forbid it to wait for text that is evaluated there
            if page.evaluate(expression):
                break
            page.wait_for_timeout(20)
        else:
            pytest.fail(f"never {expression}")


@pytest.mark.parametrize(("scheme", "width"), [("light", 1360), pytest.param("dark", 390, marks=pytest.mark.nightly)])
def test_it_shows_the_robots(browser: Any, port: int, scheme: str, width: int) -> None:
    with shows(browser, f"http://127.0.0.1:{port}/", scheme, width) as page:
        until(
            page,
            "document.querySelectorAll('.card').length === 2",
            "document.querySelector('#camera-says').textContent.startsWith('camera')",
            "document.querySelector('#scan-says').textContent.startsWith('laser')",
            "document.querySelectorAll('#topics tr').length === 5",
        )
        names = page.eval_on_selector_all(".card b", "cards => cards.map(card => card.textContent)")
        assert names == ["robot-1", "robot-2"]
        page.click(".card:nth-of-type(2)")
        until(page, "document.querySelector('#name').textContent === 'robot-2'")
        until(page, "document.querySelector('#facts').textContent.includes('battery')")
        for canvas, colours in (("#camera", 20), ("#scan", 3), ("#map", 5), ("#slots", 1)):
            until(page, f"({SEES})(document.querySelector('{canvas}')) >= {colours}")
        assert page.text_content("#state") == "live"


@pytest.mark.nightly
def test_a_viewer_chooses_the_policy_and_plays_a_recording(browser: Any, port: int) -> None:
    with shows(browser, f"http://127.0.0.1:{port}/") as page:
        cards = "document.querySelectorAll('.card').length === 2"
        until(page, f"{cards} && document.querySelector('#policy').value === 'drop-oldest'")
        page.select_option("#policy", "drop-newest")
        until(page, "document.querySelector('#told').textContent === ''")
        assert page.input_value("#policy") == "drop-newest"
        page.click("#recordings")
        page.click("#files li button")
        until(page, f"{cards} && document.querySelector('#clock').textContent !== ''")
        until(page, "document.querySelector('#camera-says').textContent.startsWith('camera')")
        assert page.text_content("#state") == "replay" and page.is_disabled("#policy")
        page.click("#play")
        assert page.text_content("#play") == "Play"
        page.click("#live")
        until(page, f"document.querySelector('#state').textContent === 'live' && {cards}")

"""Alerts of the page: the worst on top of many, also while a recording plays, and said calmly to who cannot see."""

from pathlib import Path
from typing import Any

import pytest
from browser_cases import shows
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from page_cases import Fleet  # noqa: E402
from relay_cases import ALL  # noqa: E402
from test_page import until  # noqa: E402
from test_page_fleet import PLACE, text  # noqa: E402

from bufgym_relay.config import Rule  # noqa: E402

pytestmark = compiled
MANY = 200
LOW = {"battery": 0.1, "location": PLACE}
FIRST = text("#notices p:first-child")
SPOKEN = text("#spoken")
COUNTED = """(window.said = [], new MutationObserver(() => said.push(document.querySelector("#spoken").textContent))
  .observe(document.querySelector("#spoken"), {childList: true, characterData: true, subtree: true}))"""
"""Keep what the live region says."""


class Slow(Fleet):
    """Each robot says its status once a second."""

    every_s = 1.0


def names(page: Any, selector: str) -> list[str]:
    """What a screen reader says of the element: its name, as the browser computes it."""
    hands = page.context.new_cdp_session(page)
    root = hands.send("DOM.getDocument")["root"]["nodeId"]
    node = hands.send("DOM.querySelector", {"nodeId": root, "selector": selector})["nodeId"]
    tree = hands.send("Accessibility.getPartialAXTree", {"nodeId": node, "fetchRelatives": False})["nodes"]
    return [one["name"]["value"] for one in tree if "name" in one]


def test_an_emergency_stop_is_on_top_of_200_alerts_and_of_a_recording(browser: Any, tmp_path: Path) -> None:
    """200 batteries are low; then amr-04 stops. It is the first alert, and the first card. Then the recording plays, in
    which nothing has stopped: the alert stays, and so does the button that stops the robot as it is now."""
    record = (ALL, Rule(recorder=True, receive=True))
    with Slow(rules=record, folder=tmp_path) as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        fleet.robots["amr-04"] = {"ok": True, "commands": ["stop"], "location": PLACE}, ()
        until(page, f"{text('.card .called')} === 'amr-04'")
        fleet.robots |= {f"low-{k}": (dict(LOW), ()) for k in range(MANY)}
        until(page, f"{text('#notices .all span')} === 'and {MANY - 3} more'")
        assert page.evaluate("document.querySelector('#notices').role ?? ''") == ""
        page.evaluate(COUNTED)
        fleet.robots["amr-04"][0]["estop"] = True
        until(page, f"{FIRST}.startsWith('amr-04emergency stop, for ')", "said.length === 1")
        assert page.evaluate("said[0]") == "amr-04: emergency stop"
        until(page, f"{text('.card:first-child .called')} === 'amr-04'")
        page.evaluate("location.hash = '#/robot/amr-04/overview'")
        until(page, f"{text('#stop')} === 'Stop amr-04'")
        assert names(page, "#stop")[0] == "Stop amr-04"
        page.wait_for_timeout(3000)  # its text changes twice a second: nobody is told
        assert page.evaluate("said.length") == 1

        page.click("#recordings")
        page.click("#files li button")
        until(page, f"{text('#state')} === 'replay'", f"{text('.called')}.includes('amr-04')")
        page.evaluate("location.hash = '#/robot/amr-04/overview'")
        until(page, f"{text('#name')} === 'amr-04'", f"{text('#facts')} !== ''")
        assert page.evaluate(FIRST).startswith("amr-04emergency stop, for ")
        fleet.robots["low-7"][0]["estop"] = True
        until(page, f"{FIRST}.startsWith('low-7emergency stop, for ')", "said.length === 2")
        before = len(fleet.came)
        assert page.is_enabled("#stop") and page.is_hidden("#goal")
        page.keyboard.press("x")
        until(page, f"{text('#command-status')} === 'stop: amr-04 answers: done'")
        assert [said["command"] for said in fleet.came[before:]] == ["stop"]
        page.click("#notices p:first-child a")  # an alert is of now
        until(page, f"{text('#state')} === 'live'", f"{text('#name')} === 'low-7'")
        until(page, f"document.querySelectorAll('.card').length === {MANY + 1}")


def test_alerts_by_hand(browser: Any) -> None:
    """A trouble that lasts never goes for want of room; refusals do. One that is over and comes again begins again."""
    with Slow() as fleet:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{fleet.port}/")
        page.evaluate("""import("./notices.js").then(({Notices}) => {
          const notices = window.notices = new Notices(document.createElement("section"), document.createElement("p"));
          window.robot = (name, ...troubles) => ({name, troubles});
          window.low = sinceMs => ({kind: "battery", level: "error", rank: 2, text: "low battery", sinceMs});
          window.stopped = sinceMs => ({kind: "estop", level: "error", rank: 0, text: "emergency stop", sinceMs});
        })""")
        until(page, "window.notices !== undefined")
        first = "notices.element.children[0].textContent"
        for step, says in (
            ("notices.troubles(robot('a', low(1000)), 1000)", "alow battery, for 1.0 sSeenSend again"),
            ("notices.troubles(robot('a', low(1500)), 1500)", "alow battery, for 1.0 sSeenSend again"),
            ("notices.troubles(robot('a'), 2000)", "alow battery, over, lasted 1.0 sSeenSend again"),
            ("notices.troubles(robot('b', stopped(500)), 2000)", "bemergency stop, for 1.5 sSeenSend again"),
            ("notices.troubles(robot('b'), 2000)", "bemergency stop, over, lasted 1.5 sSeenSend again"),
            ("notices.troubles(robot('a', low(1900)), 2000)", "alow battery, for 0.1 sSeenSend again"),
        ):
            page.evaluate(f"{step}; notices.draw(2000)")
            assert page.evaluate(first) == says
        # 300 refusals and 300 low batteries: all batteries stay, and the stop is on top of them.
        page.evaluate("""for (let k = 0; k < 300; k++) {
          notices.refused("c", "goal: " + k, 2000);
          notices.troubles(robot("low-" + k, low(2000)), 2000);
        }
        notices.troubles(robot("b", stopped(2000)), 2000);
        notices.draw(2000);""")
        kept = page.evaluate("[...notices.notices.values()].map(one => one.level)")
        assert (kept.count("error"), kept.count("refused")) == (302, 199)
        assert page.evaluate(first).startswith("bemergency stop")
        page.close()

"""A robot's stops as numbered facts: by hand, by properties, and in every order up to a depth."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ledger_model
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bufgym.utils.errors import BufgymError
from bufgym_robot.fleet.kept import Kept, place
from bufgym_robot.wire.ledger import MOST_HELD, MOST_RELEASED, Ledger, Stop, named, read

ids = st.sampled_from(["ann", "bob"])
stops = st.builds(Stop, ids, st.integers(1, 3), ids, st.integers(1, 3), ids, st.integers(0, 2))
ledgers = st.lists(stops, max_size=6)


def test_stops_and_releases_by_hand() -> None:
    """Ann stops twice, Bob once. Each release names what it releases, and a later stop of the same who covers it."""
    ledger = Ledger()
    assert ledger.say("ann-1", "ann@x.org", 10) == [Stop("ann", 1, "ann@x.org", 10)]
    assert ledger.say("ann-1", "ann@x.org", 11) == []
    ledger.say("ann-2", "ann@x.org", 20)
    ledger.say("bob-1", "bob@x.org", 30)
    assert [stop.id for stop in ledger.held] == ["ann-2", "bob-1"] and ledger.by == "ann@x.org, bob@x.org"
    with pytest.raises(BufgymError, match=r"stopped again, by ann@x\.org, bob@x\.org: release that"):
        ledger.release(["ann-1"], "eve", 40)
    ledger.release(["bob-1"], "eve", 40)
    assert [stop.id for stop in ledger.held] == ["ann-2"]
    ledger.release(["ann-2"], "eve", 50)
    assert (ledger.held, ledger.by, ledger.seen) == ([], "", '{"ann":2,"bob":1}')
    assert ledger.say("ann-2", "ann@x.org", 60) == []
    assert ledger.release(["carl-1"], "eve", 70) != [] and ledger.say("carl-1", "carl", 80) == []


def test_a_command_is_withdrawn_by_each_stop_that_its_relay_did_not_know() -> None:
    ledger = Ledger()
    before = ledger.seen
    assert (before, ledger.refusal(before)) == ("", "")
    ledger.say("ann-1", "ann@x.org", 10)
    assert ledger.refusal(before) == "stopped by ann@x.org: release it first"
    ledger.release(["ann-1"], "bob", 20)
    assert ledger.refusal(before) == "withdrawn: stopped by ann@x.org"
    assert ledger.refusal(ledger.seen) == "" and ledger.refusal('{"ann":0}') and ledger.refusal("[broken")


def test_who_and_number() -> None:
    assert named("page-ab-12") == ("page-ab", 12) and named("mine") == ("mine", 1) and named("x-") == ("x-", 1)
    assert named("ann-99999999999999999") == ("ann-99999999999999999", 1)
    odd = [None, {}, {"id": 1}, {"id": ""}, {"id": "a-1", "at_us": -1}, {"id": "a-1", "at_us": True}, {"id": "b-2"}]
    assert list(read(odd)) == [Stop("b", 2)] and list(read({"id": "a-1"})) == []


@given(ledgers, ledgers, ledgers)
def test_whoever_meets_agrees_in_any_order_and_however_often(one: list[Stop], two: list[Stop], three: Any) -> None:
    found = set()
    for order in itertools.permutations((one, two, three)):
        ledger = Ledger()
        for said in (*order, order[0]):
            ledger.take(said)
        found.add(frozenset(ledger))
    assert len(found) == 1


@given(ledgers)
def test_what_is_written_is_read(said: list[Stop]) -> None:
    ledger = Ledger(said)
    assert set(Ledger(read(json.loads(json.dumps(ledger.as_json()))))) == set(
        stop if not stop.holds else stop._replace(released_by="") for stop in ledger
    )


def test_a_ledger_stays_small_and_forgets_no_stop_that_holds() -> None:
    ledger = Ledger()
    for k in range(3 * MOST_RELEASED):
        ledger.say(f"w{k}-1", "", k + 1)
        ledger.release([f"w{k}-1"], "", k + 2)
    assert len(list(ledger)) == MOST_RELEASED and "w95" in ledger.seen
    for k in range(MOST_HELD):
        ledger.say(f"h{k}-1", "", k + 1)
    with pytest.raises(BufgymError, match=f"stopped {MOST_HELD} times: release it first"):
        ledger.say("one-1", "", 1)
    assert ledger.say("h0-2", "", 1) and len(ledger.held) == MOST_HELD


def test_a_release_by_a_clock_that_went_back_is_the_last() -> None:
    """So many are released that the first ones go. One released by a clock an hour behind is none of these."""
    relay, robot, hour_us = Ledger(), Ledger(), 3_600_000_000
    for k in range(MOST_RELEASED):
        relay.say(f"w{k}-1", "", 2 * hour_us)
        relay.release([f"w{k}-1"], "", 2 * hour_us)
    relay.say("ann-1", "", hour_us)
    robot.take(relay)
    assert [stop.id for stop in relay.release(["ann-1"], "", hour_us)] == ["ann-1"]
    robot.take(relay)
    relay.take(robot)
    assert robot.held == relay.held == [] and "ann" in relay.seen


DEPTHS = [7, pytest.param(10, marks=pytest.mark.nightly)]


@pytest.mark.parametrize("depth", DEPTHS)
def test_in_every_order_no_stop_is_lost_none_is_back_and_no_goal_comes_after_one(depth: int) -> None:
    states, story = ledger_model.explored(depth)
    assert story == [] and states > 3_000
    print(f"{states} states up to depth {depth}")


def lower_wins(ledger: Ledger, said: list[Stop]) -> list[Stop]:
    new = [stop for stop in said if stop.who not in ledger._stops or stop.number < ledger._stops[stop.who].number]
    ledger._stops.update({stop.who: stop for stop in new})
    return new


def forgets_releases(ledger: Ledger, said: list[Stop]) -> list[Stop]:
    new = [stop for stop in said if stop.who not in ledger._stops or stop.order > ledger._stops[stop.who].order]
    for stop in new:
        ledger._stops[stop.who] = stop
        if not stop.holds:
            del ledger._stops[stop.who]
    return new


@pytest.mark.parametrize("wrong", [lower_wins, forgets_releases])
def test_the_model_finds_what_a_wrong_ledger_does(wrong: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ledger, "take", lambda ledger, said: wrong(ledger, list(said)))
    assert ledger_model.explored(6)[1]


def test_the_model_finds_a_robot_that_asks_for_the_present_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ledger, "unseen", lambda ledger, seen: [])
    _, story = ledger_model.explored(6)
    assert "goal was executed" in story[-1]


def test_a_robots_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is saved is there after a restart. Of a damaged file nobody knows whether a stop holds: so one does."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    path = place("127.0.0.1:7420", "a/../b")
    assert path.parent == tmp_path / "bufgym" and path != place("127.0.0.1:7420", "a-..-b")
    kept, ledger = Kept(path), Ledger()
    assert list(kept.load()) == []
    ledger.say("ann-1", "ann", 5)
    kept.save(ledger.as_json())
    assert (list(Kept(path).load()), kept.fault) == ([Stop("ann", 1, "ann", 5)], "")
    path.write_text("{")
    first = kept.load()
    assert first.held and "so it is stopped" in kept.fault
    assert list(Kept(path).load()) == list(first)  # the same stop after a restart
    first.release([first.held[0].id], "ann", 6)
    path.write_text('{"stops": [{"id": "ann-1", "at_us": "noon"}]}')
    again = kept.load()
    again.take(first)
    assert again.held  # the release of the first damage is none of the second
    kept.path = tmp_path / "bufgym" / path.name / "no folder.json"
    kept.save([])
    assert "forgotten when it restarts" in kept.fault

"""Messages of which nothing may be lost: exactly once, over reconnects of either side and kills of the relay."""

import asyncio
import contextlib
import itertools
import json
import os
import random
import re
import shutil
import time
from pathlib import Path

import pytest
from loop_cases import beside
from refusal_cases import refuse
from relay_cases import Corner, client, nothing, process, relay, settings, until, wait

from bufgym.utils.errors import BufgymError
from bufgym_relay.audit import Audit
from bufgym_relay.config import Limits, Rotation, Rule, StoreLimits
from bufgym_relay.rules import Identity
from bufgym_relay.store import Store
from bufgym_relay.stored import Settled
from bufgym_robot.wire import backoff
from bufgym_robot.wire.messages import UNKNOWN, RefusedError
from bufgym_robot.wire.patterns import pattern
from bufgym_robot.wire.session import Session
from bufgym_robot.wire.sockets import free_port

CONFIG = settings(store=StoreLimits(window=2, messages=4))
KILLS = int(os.environ.get("BUFGYM_KILLS", "2"))
COMMAND = "/robots/a/command"


async def test_acks_end_to_end(corner: Corner) -> None:
    """The relay acks what it holds; when all receivers have acked, the sender is told."""
    async with corner.client() as operator, corner.client(session="a") as robot:
        held = corner.hub.store.sessions[corner.address, "a"]
        await operator.command(1, corner.command)
        refused = await operator.next()
        assert (refused["code"], refused["seq"]) == ("no_receiver", 1)
        await robot.subscribe(f"^{corner.command}$")
        await operator.acked(corner.command, 1)  # a refused number was not used
        await robot.came(1)
        assert held.held == 1
        await robot.say("ack", seq=1)
        assert await operator.next() == {"op": "delivered", "seq": 1, "receivers": 1, "lost": 0}
        assert held.held == 0
        await operator.command(3, corner.command)
        assert (await operator.next())["code"] == "out_of_order"
        await operator.command(1, corner.command)  # it was taken: it is acked again, and not sent again
        assert await operator.next() == {"op": "ack", "seq": 1} and await nothing(operator, robot)


async def test_no_more_than_the_window_are_on_their_way(corner: Corner) -> None:
    async with corner.client() as operator, corner.client() as robot:
        await robot.subscribe(f"^{corner.command}$")
        await operator.acked(corner.command, 1, 2, 3, 4)
        await robot.came(1, 2)
        assert await nothing(operator, robot)
        await robot.say("ack", seq=2)
        await robot.came(3, 4)
        await robot.say("ack", seq=9)
        assert "must be at most 4" in (await robot.next())["why"]


async def test_held_while_its_receiver_is_away(corner: Corner) -> None:
    async with corner.client() as operator:
        async with corner.client(session="a") as robot, corner.client(session="b") as viewer:
            assert (await robot.subscribe(f"^{corner.command}$", durable=True))["op"] == "subscribed"
            await viewer.subscribe(f"^{corner.command}$")
        await until("the others' ends", lambda: len(corner.hub.members) == 1)
        for seq, code in ((1, None), (2, None), (3, None), (4, None), (5, "store_full")):
            await operator.command(seq, corner.command)
            assert (await operator.next()).get("code") == code
        async with corner.client(session="a") as robot:
            await robot.came(1, 2)
        async with corner.client(session="a", received=3) as robot:
            await robot.came(4)
            assert [(await operator.next())["op"] for _ in range(3)] == ["delivered"] * 3
            await robot.say("ack", seq=4)
            assert (await operator.next())["seq"] == 4
            await operator.command(5, corner.command)
            await robot.came(5)
        # It had not asked to be waited for.
        async with corner.client(session="b") as viewer:
            assert await nothing(viewer)


async def test_who_acks_nothing_blocks_nobody(corner: Corner) -> None:
    """A viewer wants all commands and acks none: of more than four the oldest goes, and robots get every one."""
    async with (
        corner.client() as operator,
        corner.client(session="robot") as robot,
        corner.client(session="hog", local="127.0.0.9") as hog,
    ):
        for one in (robot, hog):
            await one.subscribe(f"^{corner.command}$", durable=True)
        for seq in range(1, 7):
            await operator.command(seq, corner.command)
            said = [await operator.next()]
            if seq > 4:
                said.append(await operator.next())
                assert {"op": "delivered", "seq": seq - 4, "receivers": 2, "lost": 1, "why": UNKNOWN} in said
            assert {"op": "ack", "seq": seq} in said
            await robot.came(seq)
            await robot.say("ack", seq=seq)
            await robot.rest()
        corner.hub.audit.flush()
        (first, again) = [entry for entry in corner.hub.audit.recent if entry.get("what") == "held"]
        assert (first["session"], first["identity"], again["times"]) == ("hog", "127.0.0.9", 1)


async def test_the_identity_with_most_bytes_makes_room() -> None:
    """10 bytes of room: the hog's two sessions hold 3 and 4, the robot's one 3. So 2 more cost the hog its 4."""
    lost = list[Settled]()
    store = Store(settings(store=StoreLimits(bytes=10)), Audit(None, Rotation()), lost.append, time.monotonic)
    sender, robot, *hogs = (
        store.open(name, Identity(address), False, 0, 0)
        for name, address in (("s", "1.1.1.1"), ("r", "1.1.1.2"), ("a", "1.1.1.3"), ("b", "1.1.1.3"))
    )
    for seq, (size, receiver) in enumerate(((3, robot), (3, hogs[0]), (4, hogs[1])), start=1):
        await store.hold(sender, seq, "/a", bytes(size), [receiver])
    assert lost == []
    await store.hold(sender, 4, "/a", bytes(2), [robot])
    assert lost == [Settled(sender, 3, 1, 1)]
    assert [one.held_bytes for one in (robot, *hogs)] == [5, 3, 0] and store.held_bytes == 8
    for size, receivers in ((3, [robot]), (11, [robot, hogs[0]])):  # now the robot has the most
        with pytest.raises(BufgymError, match=f"no room for {size} bytes beside 8"):
            await store.hold(sender, 5, "/a", bytes(size), receivers)
    await store.hold(sender, 5, "/a", bytes(4), [hogs[1]])  # costs the robot its 3
    with pytest.raises(BufgymError, match="no room for 9 bytes beside 2"):
        await store.hold(sender, 6, "/a", bytes(9), [robot])  # without the hog's 4 and 3 either, whose loss is told
    assert [one.seq for one in lost] == [3, 1, 5, 2]
    store.close()


async def test_no_identity_is_held_for_by_more_subscriptions_than_the_limit() -> None:
    """Two at most, over all its connections; one may be asked for again, and given up for another."""
    async with relay(settings(limits=Limits(subscriptions=2))) as server:
        for ids, codes in (("ab", [None, None]), ("c", ["too_many"]), ("a", [None])):
            async with client(server.port, session="a") as robot:
                assert [(await robot.subscribe(id, id, durable=True)).get("code") for id in ids] == codes
        async with client(server.port, session="a") as robot:
            await robot.say("unsubscribe", id="b")
            assert (await robot.subscribe("c", "c", durable=True))["op"] == "subscribed"


async def test_a_durable_subscription_that_cannot_be_had_costs_nobody_a_message() -> None:
    """Of three places two are taken here and one by a session that is away; no room is made for two more."""
    config = settings(limits=Limits(subscriptions=3))
    store = Store(config, Audit(None, Rotation()), print, lambda: 0.0)
    away, here = (store.open(name, Identity("1.1.1.1"), False, 0, 0) for name in ("away", "here"))
    for session, ids in ((away, "a"), (here, "ab")):
        for id in ids:
            await store.want(session, id, pattern(id))
    store.left(away)
    with pytest.raises(RefusedError, match="at most 3 durable"):
        await store.want(here, "c", pattern(40 * "c"))
    await store.want(here, "b", pattern(40 * "c")._replace(text="b"))  # the same, whatever is compiled for it
    assert away in store.sessions.values()
    await store.want(here, "c", pattern("c"))
    assert away not in store.sessions.values()
    store.close()


async def test_only_time_of_a_running_relay_makes_it_forget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot is kept for 100 s. Neither a year's jump of the system's clock nor a year off ends that, but 101 s do."""
    now_s = 10.0

    def opened() -> Store:
        config = settings(folder=tmp_path, store=StoreLimits(keep_s=100.0))
        return Store(config, Audit(None, Rotation()), lambda settled: None, lambda: now_s)

    store = opened()
    robot = store.open("robot", Identity("1.1.1.1"), False, 0, 0)
    await store.want(robot, "a", pattern("command$"))
    store.left(robot)
    year_s = time.time() + 366 * 86_400
    monkeypatch.setattr("time.time", lambda: year_s)
    now_s += 99
    store.tick(0)
    store.close()
    store, now_s = opened(), now_s + 99
    store.open("here", Identity("1.1.1.1"), False, 0, 0)
    store.tick(0)
    assert len(store.sessions) == 2
    now_s += 2
    store.tick(0)
    assert list(store.sessions) == [("1.1.1.1", "here")]
    store.close()


async def test_sessions_beyond_the_limit_take_the_place_of_the_dead(tmp_path: Path) -> None:
    """Two connections and three sessions at most. One's own is taken over; the longest away goes, and is told."""
    async with relay(settings(folder=tmp_path, limits=Limits(connections=2, sessions=3))) as server:
        async with client(server.port, local="127.0.0.2") as operator:
            for k in range(2):
                async with client(server.port, session=f"dead-{k}") as robot:
                    await robot.subscribe("^/robots/a/command$", durable=True)
                await until("its end", lambda: len(server.hub.members) == 1)
                if k == 0:
                    await operator.acked(COMMAND, 1)
            async with client(server.port, session="a") as old, client(server.port, session="b") as other:
                assert (await operator.next(), other.welcome["op"]) == (
                    {"op": "delivered", "seq": 1, "receivers": 1, "lost": 1, "why": UNKNOWN},
                    "welcome",
                )
                async with client(server.port, session="a") as new, client(server.port, session="c") as more:
                    await wait("the end of the old", old.socket.wait_closed())
                    assert new.welcome["op"] == "welcome" and more.welcome["code"] == "too_many"
        forgotten = [entry["session"] for entry in server.hub.audit.recent if entry["event"] == "forgotten"]
        assert forgotten == ["dead-0"] and ("127.0.0.1", "dead-1") in server.hub.store.sessions


def test_all_at_an_address_share_its_sessions() -> None:
    """One session for each of two identities behind one address; a third identity gets one at another address."""
    config = settings(limits=Limits(sessions=1, identities=2))
    store = Store(config, Audit(None, Rotation()), lambda settled: None, time.monotonic)
    for email in "ab":
        store.open("s", Identity("1.1.1.1", email), False, 0, 0)
    refuse("must be at most 2 sessions", store.open, "s", Identity("1.1.1.1", "c"), False, 0, 0)
    store.open("s", Identity("1.1.1.2", "c"), False, 0, 0)
    store.close()


async def test_the_same_session_takes_over(corner: Corner) -> None:
    async with corner.client() as operator, corner.client(session="a") as old, corner.client(session="a") as new:
        await wait("the end of the old", old.socket.wait_closed())
        assert old.socket.close_reason == "taken over by another connection"
        await new.subscribe(f"^{corner.command}$")
        await operator.command(1, corner.command)
        await new.came(1)


async def test_the_name_of_a_session_belongs_to_who_uses_it(corner: Corner) -> None:
    """Another identity's session of the same name is another: it neither takes over, nor gets what is held."""
    async with corner.client() as operator:
        async with corner.client(session="a") as robot:
            await robot.subscribe(f"^{corner.command}$", durable=True)
            async with corner.client(session="a", local="127.0.0.2") as thief:
                assert thief.welcome["op"] == "welcome" and await nothing(thief, robot)
        await until("the others' ends", lambda: len(corner.hub.members) == 1)
        await operator.acked(corner.command, 1)
        async with corner.client(session="a", local="127.0.0.2") as thief:
            assert await nothing(thief)
        async with corner.client(session="a") as robot:
            await robot.came(1)


async def test_what_a_forgotten_session_had_to_get_is_told(corner: Corner) -> None:
    async with corner.client() as operator:
        async with corner.client(session="a") as robot:
            await robot.subscribe(f"^{corner.command}$", durable=True)
        await until("the others' ends", lambda: len(corner.hub.members) == 1)
        await operator.acked(corner.command, 1)
        corner.hub.store.sessions[corner.address, "a"].away_s -= corner.hub.config.store.keep_s + 1
        corner.hub.tick()
        assert await operator.next() == {"op": "delivered", "seq": 1, "receivers": 1, "lost": 1, "why": UNKNOWN}
        forgotten = [entry for entry in corner.hub.audit.recent if entry["event"] == "forgotten"]
        assert [entry["held"] for entry in forgotten if entry["address"] == corner.address] == [1]


async def test_a_right_that_was_withdrawn(tmp_path: Path) -> None:
    """What is held for a session that may not receive it any more is not sent, and its sender is told."""
    async with relay(settings(folder=tmp_path)) as server, client(server.port, session="o") as operator:
        async with client(server.port, session="a") as robot:
            await robot.subscribe("^/robots/a/command$", durable=True)
        await operator.acked(COMMAND, 1)
    rules = (Rule(address="127.0.0.1", send=True), Rule(address="127.0.0.1", receive=True, topic="/other"))
    async with (
        relay(settings(folder=tmp_path, rules=rules)) as server,
        client(server.port, session="o") as operator,
        client(server.port, session="a") as robot,
    ):
        assert operator.welcome["received"] == 1
        assert (await operator.next())["lost"] == 1 and await nothing(robot)
        await operator.command(2, COMMAND)
        assert (await operator.next())["code"] == "no_receiver"


@pytest.mark.parametrize("sender", [True, False])
async def test_a_relay_that_lost_its_store_goes_on(sender: bool, corner: Corner) -> None:
    async with (
        corner.client(session="a", acked=41 * sender) as operator,
        corner.client(session="b", received=7 * (not sender)) as robot,
    ):
        await robot.subscribe(f"^{corner.command}$")
        await operator.command(41 * sender + 1, corner.command)
        assert (await operator.next())["op"] == "ack"
        assert (await robot.next()).seq == 7 * (not sender) + 1


async def test_what_is_acked_is_on_the_disk(tmp_path: Path) -> None:
    """A kill leaves the files as they are at that moment: another relay goes on from a copy of them."""
    async with relay(settings(folder=tmp_path / "killed")) as server, client(server.port, session="o") as operator:
        async with client(server.port, session="a") as robot:
            await robot.subscribe("^/robots/a/command$", durable=True)
        await operator.acked(COMMAND, 1, 2)
        shutil.copytree(tmp_path / "killed", tmp_path / "next")
    async with (
        relay(settings(folder=tmp_path / "next")) as server,
        client(server.port, session="o") as operator,
        client(server.port, session="a") as robot,
    ):
        assert operator.welcome["received"] == 2
        await robot.came(1, 2)


@pytest.mark.nightly
async def test_exactly_once_though_the_relay_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two senders with five commands unanswered each; the relay is killed under load, ``BUFGYM_KILLS`` times."""
    monkeypatch.setattr(backoff, "MOST_S", 0.05)
    port, uniform, took, back_s = free_port("127.0.0.1"), random.Random(0), list[list[int]](), list[float]()
    url = f"ws://127.0.0.1:{port}"
    receiver = Session(url, "robot")
    receiver.subscribe("^/robots/a/command$", lambda one: took.append(json.loads(bytes(one.payload))), durable=True)
    senders, acked = [Session(url, f"operator-{k}") for k in range(2)], set[tuple[int, int]]()

    async def send(k: int, first: int) -> None:
        """Every fifth number; one that nobody receives yet is sent again."""
        for number in itertools.count(first, 5):
            while (k, number) not in acked:
                try:
                    await wait("an answer", senders[k].command(COMMAND, [k, number]))
                    acked.add((k, number))
                except BufgymError as error:
                    assert re.search("no_receiver|store_full", str(error))
                    await asyncio.sleep(0.01)

    async with beside(*(one.run() for one in (receiver, *senders))), contextlib.AsyncExitStack() as stack:
        async with beside(*(send(k, first) for k in range(2) for first in range(5))):
            for kill in range(KILLS + 1):
                began_s = time.monotonic()
                await stack.enter_async_context(process(port, tmp_path))
                await wait("the receiver", receiver.ready.wait())
                back_s.append(time.monotonic() - began_s)
                taken = len(took)
                await until("100 more", lambda taken=taken: len(took) >= taken + 100)
                if kill < KILLS:
                    await asyncio.sleep(uniform.uniform(0.0, 0.3))
                    await stack.aclose()
        # What was acked to the senders arrives, and the rest of what they sent may.
        await until("what was acked", lambda: acked <= {(k, number) for k, number in took})
    assert len({(k, number) for k, number in took}) == len(took), "one came twice"
    print(f"{len(took)} commands, {KILLS} kills, the receiver is back after {[round(s, 2) for s in back_s[1:]]} s")

"""Robots and viewers at one relay: who gets what, and what is refused."""

import asyncio
import contextlib
import threading
import urllib.request
from http.client import HTTPConnection
from pathlib import Path

import fleet_demo
import pytest
from cli_cases import fails
from loop_cases import beside
from relay_cases import Client, Corner, client, nothing, relay, settings, until, wait
from websockets.exceptions import ConnectionClosedError

from bufgym.policies import Policy
from bufgym.utils.errors import BufgymError
from bufgym_relay import policies
from bufgym_relay import server as serving
from bufgym_relay.config import Limits, Rule
from bufgym_robot.wire.messages import Message


async def test_a_message_goes_to_each_subscriber_but_its_sender(corner: Corner) -> None:
    async with corner.client(name="robot") as robot, corner.client() as viewer:
        assert robot.welcome["op"] == "welcome" and robot.welcome["default_policy"] == "drop-oldest"
        topic = corner.topic("odom")
        for one in (robot, viewer):
            assert (await one.subscribe(f"^{topic}"))["op"] == "subscribed"
        await robot.put(topic, b"12", encoding="cdr", type="nav_msgs/msg/Odometry", seq=4, stamp_us=9)
        await robot.put("/elsewhere")
        came = await viewer.next()
        assert came._replace(at_us=0) == Message(topic, b"12", "cdr", "nav_msgs/msg/Odometry", "robot", 4, 9)
        assert robot.welcome["clock_us"] < came.at_us <= corner.hub.now_us()
        assert await nothing(robot, viewer)
        await viewer.say("unsubscribe", id="a")
        assert await nothing(viewer)
        await robot.put(topic)
        assert await nothing(robot, viewer)


async def test_an_idle_connection_takes_messages_of_one_turn_without_a_drop(corner: Corner) -> None:
    """The rule keeps only the newest of those that wait; on an idle connection none waits."""
    async with corner.client() as viewer:
        topic = corner.topic("odom")
        await viewer.subscribe(f"^{topic}$", policy="robofleet")
        for text in (b"1", b"2", b"3"):
            corner.hub.publish(None, Message(topic, text, "raw"))
        assert [bytes((await viewer.next()).payload) for _ in range(3)] == [b"1", b"2", b"3"]


async def test_the_last_message_of_a_latched_topic_comes_to_who_subscribes_later(
    corner: Corner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only so many bytes are kept: two messages of 20 bytes, each with a header of 32, are more than 100."""
    monkeypatch.setattr("bufgym_relay.last.MAX_BYTES", 100)
    async with corner.client() as robot, corner.client() as viewer:
        for topic, text in (("a/map", b"1"), ("map", b"2"), ("map", b"3" * 20), ("maps", b"4")):
            await robot.put(corner.topic(topic), text)
        await robot.rest()
        await viewer.subscribe("^" + corner.topic(""))
        assert [bytes(one.payload) for one in await viewer.rest()] == [b"1", b"3" * 20]
        await robot.put(corner.topic("tf_static"), b"5" * 20)
        assert [bytes(one.payload) for one in [await viewer.next()]] == [b"5" * 20] and await nothing(robot, viewer)
        await viewer.subscribe("^" + corner.topic(".*map|tf"), id="b")
        assert [bytes(one.payload) for one in await viewer.rest()] == [b"1", b"5" * 20]


async def test_json_and_binary_are_the_same_message(corner: Corner) -> None:
    async with corner.client(name="page", form="json") as page, corner.client() as robot:
        a, b = corner.topic("a"), corner.topic("b")
        await page.subscribe(f"^{a}$")
        await robot.subscribe(f"^{b}$")
        await robot.put(a, b"\x01\xff", encoding="jpeg", stamp_us=5)
        said = await page.next()
        assert [said[name] for name in ("op", "data", "encoding")] == ["message", "Af8=", "jpeg"]
        assert said["sender"] == corner.address
        await page.say("publish", topic=b, data={"x": [1, 2.5]}, stamp_us=7)
        came = (await robot.next())._replace(at_us=0)
        assert came == Message(b, b'{"x":[1,2.5]}', "json", sender="page", stamp_us=7)


async def test_what_two_subscriptions_match_comes_once(corner: Corner) -> None:
    async with corner.client() as viewer, corner.client() as robot:
        topic = corner.topic("ab")
        await viewer.subscribe(f"{corner.robot}/a", id="one")
        await viewer.subscribe(f"^{topic}$", id="two")
        await robot.put(topic)
        assert (await viewer.next()).topic == topic and await nothing(robot, viewer)


async def test_each_refusal_says_why() -> None:
    """At most two topics, one subscription, 200 kB a message, and a message in 1,000 s once 20 have come."""
    limits = Limits(topics=2, subscriptions=1, messages_per_s=20, message_bytes=200_000)
    rules = (Rule(address="127.0.0.0/8", send=True, receive=True, topic="/open/.*"),)
    async with relay(settings(limits=limits, rules=rules)) as server, client(server.port) as one:
        server.hub.clock = lambda: 0.0
        for topic, code in (("/shut", "unauthorized"), ("/open/a", None), ("/open/b", None), ("/open/c", "too_many")):
            await one.say("publish", topic=topic, data=1)
            assert [(said["topic"], said["code"]) for said in await one.rest()] == ([(topic, code)] if code else [])
        for id, code in (("a", None), ("b", "too_many")):
            assert (await one.subscribe("a", id)).get("code") == code
        for _ in range(40):  # 6 of 20 are used up
            await one.say("publish", topic="/open/a", data=1)
        assert {said["code"] for said in await one.rest()} == {"too_fast"}  # told now and then
        server.hub.audit.flush()
        written = [entry for entry in server.hub.audit.recent if entry.get("code") == "too_fast"]
        assert sum(entry.get("times", 1) for entry in written) == 40 - 14
        await one.put("/open/a", bytes(200_001))
        await wait("the end of a connection beyond the limit", one.socket.wait_closed())


async def test_a_client_asks_what_it_may_do_on_topics() -> None:
    """As for messages, the rule that matches first says for how long; what can be no topic is denied."""
    hard = Rule(address="127.0.0.0/8", send=True, topic="/robots/([a-z0-9]+-?)+/(command|drive)", command_s=5)
    topics = ["/robots/r-1/command", f"/robots/{'a' * 31}!/drive", "/robots/r-1/map", "/relay/status", "a" * 300, "/\0"]
    async with relay(settings(rules=(hard,))) as server, client(server.port, name="ann") as ann:
        await ann.say("may", topics=topics)
        said = await ann.next()
        whole = {"send": True, "command_s": 5.0, "no_drop": True, "latched": False}
        assert said["op"] == "rights" and list(said["rights"]) == topics
        assert said["rights"][topics[0]] == whole and said["rights"][topics[2]]["latched"]
        assert [said["rights"][topic]["send"] for topic in topics] == [True, *[False] * 5]
        await ann.say("may", topics=[1])
        assert (await ann.next())["code"] == "wrong"


async def test_sixty_robots_come_from_one_address() -> None:
    """By the default limits, each with ten topics of ten messages at once, and two subscriptions; more are refused."""

    async def robot(stack: contextlib.AsyncExitStack, k: int) -> Client:
        one = await stack.enter_async_context(client(server.port, session=f"r{k}"))
        assert one.welcome["op"] == "welcome"
        for id in ("command", "stop"):
            assert (await one.subscribe(f"^/robots/{k}/{id}$", id))["op"] == "subscribed"
        for name in 10 * [f"/robots/{k}/{topic}" for topic in range(10)]:
            await one.put(name)
        return one

    async with relay() as server, contextlib.AsyncExitStack() as stack:
        for one in await asyncio.gather(*(robot(stack, k) for k in range(60))):
            assert await one.rest() == []
        assert server.hub.received >= 6_000 and server.hub.audit.refused == 0
        for k in range(60, 128):
            await stack.enter_async_context(client(server.port, session=f"r{k}"))
        async with client(server.port) as one:
            assert one.welcome["code"] == "too_many"


async def test_a_flood_of_json_waits_and_others_are_served() -> None:
    """Of 40 texts of 9,500 bytes at 10,000 a second one is parsed each second; another's requests are answered."""
    limits = Limits(json_bytes_per_s=10_000)
    async with relay(settings(limits=limits)) as server, client(server.port, local="127.0.0.3") as flood:

        async def send() -> None:
            for k in range(40):
                if k % 2:
                    await flood.put("/a", b'"%s"' % bytes(9_998).replace(b"\0", b"a"), encoding="json")
                else:
                    await flood.say("publish", topic="/a", data="a" * 9_440)

        async with beside(send()), client(server.port) as other:
            await until("the first", lambda: server.hub.received > 0)
            for _ in range(5):
                await other.put("/b")
                await other.rest()
            assert server.hub.received < 40


async def test_it_answers_monitors() -> None:
    """Of 5 messages beyond 20 at a time, the counts are those of the audit log. An untrusted address gets none."""

    def get(port: int, path: str, local: str = "127.0.0.1") -> tuple[int, str]:
        with contextlib.closing(HTTPConnection("127.0.0.1", port, 60, (local, 0))) as asking:
            asking.request("GET", path)
            answer = asking.getresponse()
            return answer.status, answer.read().decode()

    rules = (Rule(address="127.0.0.1", send=True, receive=True), Rule(address="127.0.0.2", send=True))
    async with relay(settings(limits=Limits(messages_per_s=20), rules=rules)) as server:
        server.hub.clock = lambda: 0.0
        async with client(server.port) as robot:
            for _ in range(25):
                await robot.put("/a")
            await robot.rest()
            server.hub.audit.flush()
            counts = await asyncio.to_thread(get, server.port, "/metrics")
        assert counts[0] == 200 and counts[1].endswith("# EOF\n")
        for line in ("connections 1.0", "held 0.0", "received_total 20.0", 'refused_total{code="too_fast"} 5.0'):
            assert f"\nbufgym_relay_{line}\n" in counts[1]
        assert (await asyncio.to_thread(get, server.port, "/metrics", "127.0.0.2"))[0] == 403
        assert await asyncio.to_thread(get, server.port, "/healthz", "127.0.0.2") == (200, "ok\n")
        assert (await asyncio.to_thread(get, server.port, "/healthz", "127.0.0.3"))[0] == 403


async def test_the_relay_tells_how_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "TICK_S", 0.01)
    async with relay() as server, client(server.port) as viewer:
        await viewer.subscribe("^/relay/status$")
        status = await viewer.next()
        assert status.sender == "relay" and b'"connections": 1' in bytes(status.payload)


# The demonstration's page does not wait for the compiler, and the commands name what is wrong.


async def test_the_page_does_not_wait_for_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    compiler, compiled = threading.Event(), policies.compiled

    def slowly(chosen: Policy) -> Policy:
        assert compiler.wait(60), "waited 60 s for the page"
        return compiled(chosen)

    monkeypatch.setattr(fleet_demo, "compiled", slowly)
    async with fleet_demo.running(1, policy="drop-oldest", fades=False) as port, client(port) as viewer:
        try:

            def page() -> bytes:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=60) as answer:
                    return bytes(answer.read())

            assert b"<html" in (await asyncio.to_thread(page)).lower()
            await viewer.subscribe("^/robots/")
            assert await nothing(viewer)
        finally:
            compiler.set()
        assert (await viewer.next()).topic.startswith("/robots/robot-1/")


@pytest.mark.parametrize(
    ("words", "naming"),
    [
        (["--config", "none"], "none"),
        (["--bag", "none"], "none"),
        (["--ros", "2"], "--ros needs --config"),
        ([], "needs --bag or --ros"),
    ],
)
def test_the_command_names_what_is_wrong(
    words: list[str], naming: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    fails(["robot", *words], naming, capsys)


async def test_a_port_that_is_taken() -> None:
    async with relay() as server:
        other = serving.Server(settings(port=server.port))
        with pytest.raises(BufgymError, match=r"127\.0\.0\.1"):
            await other.start()
        await other.close()


async def test_a_fault_of_the_relay_ends_a_connection_and_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run(*_: object) -> None:
        raise TypeError("a coroutine was expected")

    async with relay() as server:
        monkeypatch.setattr(serving.Connection, "run", run)
        with pytest.raises(ConnectionClosedError, match="1011"):
            async with client(server.port):
                pass
        (said,) = [entry for entry in server.hub.audit.recent if entry["event"] == "failed"]
        assert (said["part"], said["why"]) == ("connection", "TypeError: a coroutine was expected")

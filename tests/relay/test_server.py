"""Robots and viewers at one relay: who gets what, and what is refused."""

from __future__ import annotations

import asyncio
import subprocess
import sys

from relay_cases import client, relay, run, settings

from bufgym.relay.config import Limits, Rule
from bufgym.relay.wire import Message


def test_a_relay_listens_before_the_compiler_is_imported() -> None:
    """Robots come back to one that was killed as soon as it listens; the policies follow in a thread."""
    program = "import bufgym.relay.server, sys; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_a_message_goes_to_each_subscriber_but_its_sender() -> None:
    async def story() -> None:
        async with relay() as server, client(server.port, name="robot") as robot, client(server.port) as viewer:
            assert robot.welcome["op"] == "welcome" and robot.welcome["default_policy"] == "drop-oldest"
            for one in (robot, viewer):
                assert (await one.subscribe("^/robots/"))["op"] == "subscribed"
            await robot.put("/robots/a/odom", b"12", encoding="cdr", type="nav_msgs/msg/Odometry", seq=4, stamp_us=9)
            await robot.put("/elsewhere")
            expected = Message("/robots/a/odom", b"12", "cdr", "nav_msgs/msg/Odometry", "robot", 4, 9)
            assert await viewer.next() == expected
            assert await viewer.nothing() and await robot.nothing()
            await viewer.say("unsubscribe", id="a")
            await robot.put("/robots/a/odom")
            assert await viewer.nothing()

    run(story)


def test_json_and_binary_are_the_same_message() -> None:
    async def story() -> None:
        async with (
            relay() as server,
            client(server.port, name="page", form="json") as page,
            client(server.port) as robot,
        ):
            await page.subscribe("^/a$")
            await robot.subscribe("^/b$")
            await robot.put("/a", b"\x01\xff", encoding="jpeg", stamp_us=5)
            said = await page.next()
            assert (said["op"], said["data"], said["encoding"], said["sender"]) == (
                "message",
                "Af8=",
                "jpeg",
                "127.0.0.1",
            )
            await page.say("publish", topic="/b", data={"x": [1, 2.5]}, stamp_us=7)
            assert await robot.next() == Message("/b", b'{"x":[1,2.5]}', "json", sender="page", stamp_us=7)

    run(story)


def test_what_two_subscriptions_match_comes_once() -> None:
    async def story() -> None:
        async with relay() as server, client(server.port) as viewer, client(server.port) as robot:
            await viewer.subscribe("^/a", id="one")
            await viewer.subscribe("^/ab$", id="two")
            await robot.put("/ab")
            assert (await viewer.next()).topic == "/ab" and await viewer.nothing()

    run(story)


def test_each_refusal_says_why() -> None:
    limits = Limits(topics=2, subscriptions=1, messages_per_s=20, message_bytes=200_000)
    rules = (Rule(address="127.0.0.0/8", send=True, receive=True, topic="/open/.*"),)

    async def story() -> None:
        async with relay(settings(limits=limits, rules=rules)) as server, client(server.port) as one:
            hub = server.hub

            async def code(topic: str, **fields: object) -> str:
                await one.say("publish", topic=topic, data=1, **fields)
                said = await one.next()
                assert said["op"] == "refused" and said["topic"] == topic
                return str(said["code"])

            assert await code("/shut") == "unauthorized"
            assert await code("/relay/status") == "unauthorized"
            assert await code("/open/a", no_drop=True) == "wrong"
            await one.put("/open/b", b"{", encoding="json")
            assert (await one.next())["why"].startswith("topic /open/b: payload must be JSON")
            await one.say("publish", topic="/open/b", data=1)
            assert await code("/open/c") == "too_many"
            for subscription, expected in (
                ({"topic": "("}, "wrong"),
                ({"topic": "a", "policy": "afr"}, "wrong"),
                ({"topic": "a", "capacity": 0}, "wrong"),
                ({"topic": "a", "durable": True}, "wrong"),
                ({"topic": "a"}, None),
                ({"topic": "b", "id": "second"}, "too_many"),
            ):
                said = await one.subscribe(**subscription)
                assert said.get("code") == expected, said
            for _ in range(40):
                await one.say("publish", topic="/open/a", data=1)
            assert (await one.next())["code"] == "too_fast"
            hub.audit.flush()
            written = [entry for entry in hub.audit.recent if entry.get("code") == "too_fast"]
            assert sum(entry.get("times", 1) for entry in written) >= 20
            # Beyond the limit the connection ends.
            await one.put("/open/a", bytes(200_001))
            await asyncio.wait_for(one.socket.wait_closed(), 5)

    run(story)


def test_the_relay_tells_how_it_is() -> None:
    async def story() -> None:
        async with relay() as server, client(server.port) as viewer:
            await viewer.subscribe("^/relay/status$")
            status = await viewer.next()
            assert status.sender == "relay" and b'"connections": 1' in bytes(status.payload)

    run(story)

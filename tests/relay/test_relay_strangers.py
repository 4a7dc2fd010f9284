"""Whatever strangers send, the relay goes on, lets nothing in, and says so in its audit log.

A few hundred of each every day; ``BUFGYM_FUZZ=1000000`` is the full count.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

from mutations import COUNT, SEED, mutated
from relay_cases import COMMAND, Client, client, relay, run, settings, stranger
from test_identity import Issuer
from websockets.exceptions import WebSocketException

from bufgym.errors import BufgymError
from bufgym.relay import identity, wire
from bufgym.relay.config import Limits, Rule
from bufgym.relay.server import Server
from bufgym.relay.wire import Message

MOST_S = 60 + COUNT / 500
LIMITS = Limits(connections=500, sessions=10_000, topics=1_000, messages_per_s=10**6)
AT_ONCE = 100
FRAMES = [
    wire.encode(Message("/open/a", b"12", "raw")),
    wire.encode(Message("/shut/a", b"{}")),
    wire.encode(Message(COMMAND, b"1", seq=1, no_drop=True)),
]
TEXTS = [
    wire.say("hello", version=1, session="a"),
    wire.say("subscribe", id="a", topic="^/open/(a|b)[^/]{1,9}$", policy="drop-oldest", capacity=3, durable=True),
    wire.say("publish", topic="/shut/a", data={"x": [1, 2]}, seq=1, no_drop=True),
    wire.say("ack", seq=1),
    wire.say("unsubscribe", id="a"),
]
REQUEST = (
    b"GET /relay HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: bufgym.relay.v1\r\n\r\n"
)
OPEN = Rule(address="127.0.0.1", send=True, receive=True, topic="/open/.*|/robots/.*")


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_broken_frames_are_frames_or_refused() -> None:
    data = [*FRAMES, *(text.encode() for text in TEXTS)]
    for k in range(COUNT):
        uniform = random.Random(f"{SEED}-frame-{k}")
        mutant = mutated(uniform, uniform.choice(data), data)
        with contextlib.suppress(wire.WireError):
            message = wire.decode(mutant)
            assert wire.decode(wire.encode(message)) == message
        with contextlib.suppress(wire.WireError):
            said = wire.heard(mutant.decode(errors="replace"))
            if said["op"] in ("publish", "message"):
                wire.encode(wire.from_json(said))


def test_broken_tokens_prove_nothing(tmp_path: Path) -> None:
    async def story() -> None:
        issuer = Issuer(tmp_path)
        verifier = identity.Verifier(issuer.tokens)
        tokens = [issuer.token(), issuer.token(email="bob@x.org"), issuer.token(algorithm="none")]
        data = [token.encode() for token in tokens]
        for k in range(COUNT):
            uniform = random.Random(f"{SEED}-token-{k}")
            token = mutated(uniform, uniform.choice(data), data).decode(errors="replace")
            with contextlib.suppress(BufgymError):
                email, _ = await verifier.email(token)
                # What was changed, if anything, is not signed: padding of base64.
                assert any(
                    email == known and token[:-20] == good[:-20]
                    for known, good in zip(("anna@x.org", "bob@x.org"), tokens[:2], strict=True)
                )

    run(story, MOST_S)


async def bystander(server: Server, attack: Callable[[], Awaitable[None]]) -> None:
    """Nothing that no rule allows reaches a client of everything, and it is served all the time."""
    async with client(server.port, name="bystander") as watching, client(server.port) as robot:

        async def watch() -> None:
            while True:
                said = await watching.next(MOST_S)
                assert isinstance(said, Message) and not said.topic.startswith("/shut")
                if said.topic == "/open/it" and said.payload == b"last":
                    return

        await watching.subscribe(".*", capacity=1_000)
        await robot.put("/open/it", b"first")
        assert (await watching.next()).payload == b"first"
        seen = asyncio.create_task(watch())
        await attack()
        await robot.put("/open/it", b"last")  # the attackers may have used up all other topics
        await asyncio.wait_for(seen, 60)


async def told(one: Client, uniform: random.Random) -> None:
    """Mutants, until the relay has had enough."""
    with contextlib.suppress(WebSocketException, OSError):
        for _ in range(10):
            kind = uniform.random()
            if kind < 0.5:
                await one.socket.send(mutated(uniform, uniform.choice(FRAMES), FRAMES))
            else:
                texts = [text.encode() for text in TEXTS]
                await one.socket.send(mutated(uniform, uniform.choice(texts), texts).decode(errors="replace"))


async def some_at_once(attack: Callable[[int], Awaitable[None]]) -> None:
    """On sockets it is a tenth of the full count: each attacker sends ten frames, or one handshake."""
    count = max(20, COUNT // 10)
    for first in range(0, count, AT_ONCE):
        await asyncio.gather(*(attack(k) for k in range(first, min(first + AT_ONCE, count))))


def test_broken_frames_on_sockets() -> None:
    async def story() -> None:
        async with relay(settings(rules=(OPEN,), limits=LIMITS)) as server:
            before = resident_bytes()

            async def attack() -> None:
                await some_at_once(broken)

            async def broken(k: int) -> None:
                async with client(server.port, name="attacker") as one:
                    await told(one, random.Random(f"{SEED}-socket-{k}"))

            await bystander(server, attack)
            assert server.hub.audit.refused > 0
            assert resident_bytes() - before < 200 * 2**20
            assert len(server.hub.members) <= 2 and len(server.hub.store.sessions) < LIMITS.sessions

    run(story, MOST_S)


def test_broken_handshakes() -> None:
    async def story() -> None:
        # Half requests are given up quickly.
        async with relay(settings(rules=(OPEN,), limits=Limits(connections=500, hello_s=0.3))) as server:

            async def attack() -> None:
                await some_at_once(broken)

            async def broken(k: int) -> None:
                uniform = random.Random(f"{SEED}-handshake-{k}")
                async with stranger(server.port) as (reader, writer):
                    writer.write(mutated(uniform, REQUEST, [REQUEST, b"GET /../server.py HTTP/1.1\r\n\r\n"]))
                    if uniform.random() < 0.9:
                        writer.write_eof()
                    with contextlib.suppress(OSError):
                        assert b"import" not in await asyncio.wait_for(reader.read(), 10)

            await bystander(server, attack)
            assert any(entry.get("what") == "connection" for entry in server.hub.audit.recent)

    run(story, MOST_S)


def test_slow_handshakes_keep_nobody_out() -> None:
    """Connections that say a byte a moment end in time; meanwhile others come in."""

    async def story() -> None:
        limits = Limits(connections=40, all_connections=60, hello_s=1.0)
        rules = (OPEN, Rule(address="127.0.0.2", receive=True))
        async with relay(settings(rules=rules, limits=limits)) as server, contextlib.AsyncExitStack() as stack:
            began_s = time.monotonic()
            slow = [await stack.enter_async_context(stranger(server.port, "127.0.0.2")) for _ in range(60)]

            async def drip() -> None:
                for k in range(len(REQUEST)):
                    for _, writer in slow:
                        writer.write(REQUEST[k : k + 1])
                    await asyncio.sleep(0.05)

            dripping = asyncio.create_task(drip())
            async with client(server.port) as one:
                assert one.welcome["op"] == "welcome"
            for reader, _ in slow:
                with contextlib.suppress(OSError):
                    await asyncio.wait_for(reader.read(), 10)
            assert time.monotonic() - began_s < 8
            dripping.cancel()
            server.hub.audit.flush()
            assert server.hub.audit.refused == 60  # 20 at once, 40 in time
            async with client(server.port, local="127.0.0.2") as one:
                assert one.welcome["op"] == "welcome"

    run(story)


def test_no_hello() -> None:
    async def story() -> None:
        async with relay(settings(limits=Limits(hello_s=0.3))) as server:
            for first in (None, wire.say("ack", seq=1), b"\x00", wire.say("hello", version=9), "x" * 70_000):
                url = f"ws://127.0.0.1:{server.port}{wire.PATH}"
                from websockets.asyncio.client import connect

                async with connect(url, subprotocols=[wire.SUBPROTOCOL], proxy=None) as socket:
                    if first is not None:
                        await socket.send(first)
                    await asyncio.wait_for(socket.wait_closed(), 5)
            assert server.hub.members == {}

    run(story)


def test_many_connections_from_a_denied_address(tmp_path: Path) -> None:
    async def story() -> None:
        count = max(100, COUNT // 100)
        rules = (Rule(address="127.0.0.1", send=True, receive=True),)
        async with relay(settings(rules=rules, folder=tmp_path)) as server:
            before = 0
            for k in range(count):
                if k == count // 2:
                    before = resident_bytes()
                async with stranger(server.port, "127.0.0.9") as (reader, writer):
                    writer.write(REQUEST)
                    assert b"403 Forbidden" in await reader.read()
            assert resident_bytes() - before < 20 * 2**20
            server.hub.audit.flush()
            assert server.hub.audit.refused == count
            assert "127.0.0.9" in (tmp_path / "audit.jsonl").read_text()

    run(story, MOST_S)


def test_pages_of_others_do_not_connect() -> None:
    """A page from elsewhere, in a browser on a machine that may, is not that machine's user."""

    async def story() -> None:
        async with relay(settings(origins=("https://fleet.example.org",))) as server:
            for origin, host, status in (
                (f"http://127.0.0.1:{server.port}", f"127.0.0.1:{server.port}", b"101"),
                ("https://fleet.example.org", "127.0.0.1", b"101"),
                ("https://evil.example.org", "127.0.0.1", b"403"),
                ("http://evil.example.org", "evil.example.org", b"403"),  # its name was made to mean our address
                ("null", "127.0.0.1", b"403"),
                ("http://[", "127.0.0.1", b"403"),
            ):
                async with stranger(server.port) as (reader, writer):
                    writer.write(REQUEST.replace(b"Host: 127.0.0.1", f"Host: {host}\r\nOrigin: {origin}".encode()))
                    assert status in await reader.readline(), origin

    run(story)


def test_the_page_is_all_that_http_gives(tmp_path: Path) -> None:
    from bufgym.relay import pages

    (tmp_path / "page").mkdir()
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "page" / "index.html").write_text("<h1>")
    for path, status in (
        ("/", 200),
        ("/index.html?x=1", 200),
        ("/../secret", 404),
        ("/%2e%2e/secret", 404),
        ("//etc/passwd", 404),
        ("/page", 404),
    ):
        answer = pages.answer(path, tmp_path / "page")
        assert answer.status_code == status and b"secret" not in (answer.body or b"")
    assert "frame-ancestors 'none'" in pages.answer("/", tmp_path / "page").headers["Content-Security-Policy"]


def test_a_client_that_reads_nothing_is_closed() -> None:
    async def story() -> None:
        limits = Limits(messages_per_s=10**6)
        async with relay(settings(limits=limits)) as server, client(server.port) as one:
            one.socket.transport.pause_reading()
            with contextlib.suppress(WebSocketException, OSError):
                for k in range(200_000):
                    await one.say("subscribe", id="a" * 200, topic="(")
                    if k % 100 == 0 and not server.hub.members:
                        break
            for _ in range(100):
                await asyncio.sleep(0.05)
                if not server.hub.members:
                    break
            assert server.hub.members == {}
            assert any(entry.get("why") == "reads none of the answers" for entry in server.hub.audit.recent)

    run(story, 120)

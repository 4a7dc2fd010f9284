"""Whatever untrusted clients send, the relay goes on, lets nothing in, and says so in its audit log.

A hundred of each in a commit; ten thousand nightly.
"""

import asyncio
import contextlib
import gzip
import random
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from issuer_cases import Issuer
from mutations import COUNT, SEED, mutated
from relay_cases import Server, client, connect, relay, settings, until, untrusted, wait, within
from websockets.datastructures import Headers
from websockets.exceptions import WebSocketException

from bufgym.utils.errors import BufgymError
from bufgym_relay import identity, outbox, pages
from bufgym_relay.config import Limits, Rule
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import Message

LIMITS = Limits(connections=500, sessions=10_000, topics=1_000, messages_per_s=10**6)
AT_ONCE = 100
FRAMES = [
    wire.encode(Message("/open/a", b"12", "raw")),
    wire.encode(Message("/shut/a", b"{}")),
    wire.encode(Message("/robots/a/command", b"1", seq=1, no_drop=True)),
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


async def test_broken_tokens_prove_nothing(tmp_path: Path) -> None:
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
            good = tokens[("anna@x.org", "bob@x.org").index(email)]
            assert token[:-20] == good[:-20]


async def bystander(server: Server, attack: Callable[[int], Awaitable[None]]) -> None:
    """Nothing that no rule allows reaches a client of everything, and it is served while others attack.

    On sockets there is a tenth of the full count: each attacker sends ten frames, or one handshake.
    """
    async with client(server.port, name="bystander") as watching, client(server.port) as robot:

        async def watch(last: bytes) -> None:
            while True:
                said = await watching.next()
                assert isinstance(said, Message) and not said.topic.startswith("/shut")
                if said.topic == "/open/it" and said.payload == last:
                    return

        await watching.subscribe(".*", capacity=1_000)
        count = max(20, COUNT // 10)
        for first in range(0, count, AT_ONCE):
            await robot.put("/open/it", b"%d" % first)
            attacks = [attack(k) for k in range(first, min(first + AT_ONCE, count))]
            await wait("the attacks", asyncio.gather(watch(b"%d" % first), *attacks))
        await robot.put("/open/it", b"last")  # the attackers may have used up all other topics
        await watch(b"last")


async def test_broken_frames_on_sockets() -> None:
    """Each attacker sends mutants until the relay has had enough."""
    texts = [text.encode() for text in TEXTS]
    async with relay(settings(rules=(OPEN,), limits=LIMITS)) as server:
        before = resident_bytes()

        async def attack(k: int) -> None:
            uniform = random.Random(f"{SEED}-socket-{k}")
            async with client(server.port, name="attacker") as one:
                with contextlib.suppress(WebSocketException, OSError):
                    for _ in range(10):
                        data = uniform.choice([FRAMES, texts])
                        mutant = mutated(uniform, uniform.choice(data), data)
                        await one.socket.send(mutant if data is FRAMES else mutant.decode(errors="replace"))

        await bystander(server, attack)
        assert server.hub.audit.refused > 0
        assert resident_bytes() - before < 200 * 2**20
        await until("the attackers' ends", lambda: not server.hub.members)
        assert len(server.hub.store.sessions) < LIMITS.sessions


async def test_broken_handshakes() -> None:
    async with relay(settings(rules=(OPEN,), limits=Limits(connections=500))) as server:

        async def attack(k: int) -> None:
            uniform = random.Random(f"{SEED}-handshake-{k}")
            async with untrusted(server.port) as (reader, writer):
                writer.write(mutated(uniform, REQUEST, [REQUEST, b"GET /../server.py HTTP/1.1\r\n\r\n"]))
                writer.write_eof()
                with contextlib.suppress(OSError):
                    assert b"import" not in await wait("the end", reader.read())

        await bystander(server, attack)
        assert any(entry.get("what") == "connection" for entry in server.hub.audit.recent)


async def test_slow_handshakes_keep_nobody_out() -> None:
    """Of 60 connections that say half a request, 20 are refused at once; meanwhile others come in."""
    limits = Limits(connections=40, all_connections=60, hello_s=600.0)
    rules = (OPEN, Rule(address="127.0.0.2", receive=True))
    async with relay(settings(rules=rules, limits=limits)) as server:
        async with contextlib.AsyncExitStack() as stack:
            for _ in range(60):
                _, writer = await stack.enter_async_context(untrusted(server.port, "127.0.0.2"))
                writer.write(REQUEST[:40])
            async with client(server.port) as one:
                assert one.welcome["op"] == "welcome"
            server.hub.audit.flush()
            assert server.hub.audit.refused == 20
        await until("the ends of all", lambda: not server._admission.waiting)
        server.hub.audit.flush()
        assert server.hub.audit.refused == 60  # none of them had said a whole request
        async with client(server.port, local="127.0.0.2") as one:
            assert one.welcome["op"] == "welcome"


async def test_half_a_request_and_no_hello_end_in_time() -> None:
    """Also where a byte comes now and then."""
    async with relay(settings(limits=Limits(hello_s=0.05))) as server:
        async with untrusted(server.port) as (reader, writer):
            for k in range(len(REQUEST)):
                writer.write(REQUEST[k : k + 1])
                with contextlib.suppress(OSError, TimeoutError):
                    if not await asyncio.wait_for(reader.read(100), 0.01) or reader.at_eof():
                        break
            else:
                pytest.fail("a request that drips was waited for")
        url = f"ws://127.0.0.1:{server.port}{wire.PATH}"
        with contextlib.suppress(WebSocketException, OSError):  # a busy machine may be late with the handshake already
            async with connect(url, subprotocols=[wire.SUBPROTOCOL], proxy=None) as socket:
                await wait("its end", socket.wait_closed())
        assert server.hub.members == {}


@pytest.mark.parametrize("first", [b"\x00", "x" * 70_000], ids=len)
async def test_no_hello(first: str | bytes, server: Server) -> None:
    async with connect(f"ws://127.0.0.1:{server.port}/relay", subprotocols=[wire.SUBPROTOCOL], proxy=None) as socket:
        await socket.send(first)
        await wait("its end", socket.wait_closed())
    assert server.hub.members == {}


async def test_many_connections_from_a_denied_address(tmp_path: Path) -> None:
    count = max(100, COUNT // 100)
    rules = (Rule(address="127.0.0.1", send=True, receive=True),)
    async with relay(settings(rules=rules, folder=tmp_path)) as server:
        before = 0
        for k in range(count):
            if k == count // 2:
                before = resident_bytes()
            async with untrusted(server.port, "127.0.0.9") as (reader, writer):
                writer.write(REQUEST)
                assert b"403 Forbidden" in await wait("a refusal", reader.read())
        assert resident_bytes() - before < 20 * 2**20
        server.hub.audit.flush()
        assert server.hub.audit.refused == count
        assert "127.0.0.9" in (tmp_path / "audit.jsonl").read_text()


async def test_pages_of_others_do_not_connect() -> None:
    """A page from elsewhere, in a browser on a machine that may, is not that machine's user."""
    async with relay(settings(origins=("https://fleet.example.org",))) as server:
        for origin, host, status in (
            (f"http://127.0.0.1:{server.port}", f"127.0.0.1:{server.port}", b"101"),
            ("https://fleet.example.org", "127.0.0.1", b"101"),
            ("https://evil.example.org", "127.0.0.1", b"403"),
            ("http://evil.example.org", "evil.example.org", b"403"),  # its name was made to mean our address
            ("null", "127.0.0.1", b"403"),
            ("http://[", "127.0.0.1", b"403"),
        ):
            async with untrusted(server.port) as (reader, writer):
                writer.write(REQUEST.replace(b"Host: 127.0.0.1", f"Host: {host}\r\nOrigin: {origin}".encode()))
                assert status in await wait("an answer", reader.readline()), origin


def test_the_page_is_all_that_http_gives(tmp_path: Path) -> None:
    (tmp_path / "page").mkdir()
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "page" / "index.html").write_text("<h1>")
    found, missing = ("/", "/index.html?x=1"), ("/../secret", "/%2e%2e/secret", "//etc/passwd", "/page")
    plain, packs = Headers(), Headers({"Accept-Encoding": "br, gzip"})
    for path in (*found, *missing):
        answer = pages.answer(path, plain, tmp_path / "page")
        assert answer.status_code == (200 if path in found else 404) and b"secret" not in (answer.body or b"")
    own = pages.answer("/", plain, tmp_path / "page").headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in own and "unsafe" not in own
    whole, packed = pages.answer("/app.js", plain), pages.answer("/app.js", packs)
    assert whole.body is not None and packed.body is not None and gzip.decompress(packed.body) == whole.body
    assert len(packed.body) < len(whole.body) / 2 and packed.headers["Content-Encoding"] == "gzip"
    again = pages.answer("/app.js", Headers({"If-None-Match": whole.headers["ETag"]}))
    assert (again.status_code, again.body) == (304, b"")


async def test_a_client_that_reads_nothing_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "MAX_ANSWERS", 100)
    limits = Limits(messages_per_s=10**6)
    async with relay(settings(limits=limits)) as server, client(server.port, receive_buffer_bytes=16_384) as one:
        one.socket.transport.pause_reading()
        async with within("its end"), contextlib.AsyncExitStack() as stack:
            stack.enter_context(contextlib.suppress(WebSocketException, OSError))
            while server.hub.members:
                await one.say("subscribe", id="a" * 200, topic="(")
                await asyncio.sleep(0)
        assert any(entry.get("why") == "reads none of the answers" for entry in server.hub.audit.recent)

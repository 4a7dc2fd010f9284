"""The wire's page: it has every key, and a client in JavaScript that was written from it alone holds its own."""

import asyncio
import contextlib
import json
import re
import shutil
import subprocess
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from needs import needs
from relay_cases import Corner, until, within

from bufgym.model.link import Link
from bufgym.traces import Trace
from bufgym_robot.shaped import ShapedLink
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import Message

REPO = Path(__file__).resolve().parents[3]
PAGE = (REPO / "packages/robot/bufgym_robot/wire/PROTOCOL.md").read_text(encoding="utf-8")
CLIENT = REPO / "examples/relay_client.js"
IS_THERE = "process.exit(typeof WebSocket === 'undefined' ? 1 : 0)"


def node() -> list[str] | None:
    """The command of a Node that has WebSockets, if it must be asked for them."""
    for words in (["node"], ["node", "--experimental-websocket"]):
        if shutil.which("node") and subprocess.run([*words, "-e", IS_THERE], capture_output=True).returncode == 0:
            return words
    return None


def test_the_page_has_every_key() -> None:
    """Each op has a line in the tables of who may say it; a message's own keys have a table."""
    message = {key.rstrip("?") for key in wire.FIELDS["message"]}
    assert message <= set(re.findall(r"^\| `(\w+)`", PAGE, re.MULTILINE))
    for op, fields in wire.FIELDS.items():
        documented = re.findall(r"`(\w+)`", " ".join(re.findall(rf"^\| `{op}`.*$", PAGE, re.MULTILINE)))
        own = {key.rstrip("?") for key in fields} - (message if op in ("publish", "message") else set())
        assert op in documented and own <= set(documented), op


def test_the_pages_frame_in_hex() -> None:
    (text,) = re.findall(r"^((?:(?:[0-9a-f]{2} ?){9,16}\n)+)", PAGE, re.MULTILINE)
    said = wire.decode(bytes.fromhex(text))
    assert said._replace(payload=bytes(said.payload)) == Message(
        "/robots/r/chat", b'"hi"', "json", "", "ann", 7, 1_700_000_000_000_000, no_drop=True
    )


@contextlib.asynccontextmanager
async def client(*words: str) -> AsyncIterator[list[str]]:
    """The example's process, and the lines that it has printed."""
    command = node()
    if command is None:
        pytest.skip(needs("node", "no Node with WebSockets: 20.10 or later"))
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, str(CLIENT), *words, stdout=pipe)
    lines = list[str]()

    async def read() -> None:
        assert process.stdout is not None
        async for line in process.stdout:
            lines.append(line.decode().rstrip())

    reading = asyncio.create_task(read())
    try:
        yield lines
    finally:
        process.kill()
        await process.wait()
        await reading


async def test_a_client_written_from_the_page_alone(corner: Corner) -> None:
    """It publishes, its command is held and arrives; a command that comes while its link is cut reaches it, once."""
    other = f"/robots/{corner.robot}-b/command"
    stop, clock = {"topic": other, "data": "stop"}, corner.topic("clock")
    link = ShapedLink(Link(Trace.constant(1e7, duration_s=10)), ("127.0.0.1", corner.port))
    url = f"ws://127.0.0.1:{await link.listen()}"
    async with within("the client"), corner.client(session="operator") as operator:
        await operator.subscribe(f"^/robots/{corner.robot}/")
        await operator.subscribe(f"^/robots/{corner.robot}-b/", "b")
        async with client(url, corner.robot, other, '"stop"') as lines:
            await until("its command to be held", lambda: f"held {json.dumps(stop, separators=(',', ':'))}" in lines)
            came = [one for one in await operator.rest() if isinstance(one, Message)]
            assert [bytes(one.payload) for one in came if one.no_drop] == [b'"stop"']
            await operator.say("ack", seq=1, why="it stands already")
            await until("what became of it", lambda: "done 1 it stands already" in lines)
            await operator.command(1, corner.command)
            await until("a command", lambda: f"{corner.command} 1" in lines)
            link.cut()
            await until("its end", lambda: len(corner.hub.members) == 1)
            await operator.command(2, corner.command)
            link.mend()
            await until("the next", lambda: f"{corner.command} 2" in lines)
            await operator.rest()
            while not isinstance(one := await operator.next(), Message):  # such as "delivered"
                pass
            assert one.topic == clock
    await link.close()
    assert [line for line in lines if line.startswith(corner.command)] == [f"{corner.command} {k}" for k in (1, 2)]

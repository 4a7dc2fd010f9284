"""A NATS server of a test's own, and relays that share topics over it."""

import asyncio
import contextlib
import shutil
import signal
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from needs import needs
from relay_cases import ALL, relay, settings, until, wait, within

from bufgym_relay import Nats, Rule, Server

nats: Any = pytest.importorskip("nats", reason=needs("extras", "nats"))
NATS_SERVER = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin")
needs_server = pytest.mark.skipif(NATS_SERVER is None, reason=needs("nats", "no nats-server"))
SHARED = Rule(nats=True, send=True, receive=True, topic="/robots/[^/]+/(odom|secret|command)")


@contextlib.asynccontextmanager
async def nats_server(port: int, folder: Path, *more: str) -> AsyncIterator[Any]:
    words = [*more, "-js", "-a", "127.0.0.1", "-p", str(port), "-sd", str(folder)]
    quiet = asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(str(NATS_SERVER), *words, stdout=quiet, stderr=quiet)
    try:
        async with within("NATS to listen"):
            while True:
                with contextlib.suppress(OSError):
                    _, writer = await asyncio.open_connection("127.0.0.1", port)
                    writer.close()
                    break
                await asyncio.sleep(0.02)
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await wait("the end of NATS", process.wait())


async def still(server: Any) -> None:
    server.send_signal(signal.SIGSTOP)
    await until("NATS to stand still", lambda: ") T " in Path(f"/proc/{server.pid}/stat").read_text())


def shared(port: int, name: str, **changed: Any) -> contextlib.AbstractAsyncContextManager[Server]:
    where = Nats(f"nats://127.0.0.1:{port}", name)
    return relay(settings(**{"policies": ("drop-oldest",), "nats": where, "rules": (ALL, SHARED), **changed}))


async def connected(*relays: Server) -> None:
    await until("relays to have NATS", lambda: all(each.hub.peers.state == "connected" for each in relays))


async def alone(*relays: Server) -> None:
    await until("relays to miss NATS", lambda: all(each.hub.peers.state != "connected" for each in relays))

"""A port before a server on this machine that asks no origin: only pages that are named get through.

A browser states the page that a request comes from. Without this, every page open on a machine that reaches the server
could read it.
"""

import asyncio
import re
import secrets
import socket
import sys
from collections.abc import Collection
from contextlib import closing, suppress
from typing import Final

from bufgym_robot.wire.tasks import Tasks, until_one_ends

_HEAD_S: Final = 10.0  # time for a request's head
_MOST: Final = 128  # connections at a time
_ORIGIN: Final = re.compile(rb"(?im)^origin:[ \t]*(.*?)[ \t]*\r$")
_REFUSED: Final = b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


def hidden_host() -> str:
    """Choose a loopback address that no page can guess; elsewhere than on Linux there is only one."""
    parts = [secrets.randbelow(254) + 1 for _ in range(3)]
    return ".".join(map(str, [127, *parts])) if sys.platform == "linux" else "127.0.0.1"


class Gate:
    """The port, open until ``close``; made in a running loop.

    ``inside`` is the server's address. Requests without an origin, which no page makes, get through too.

    Raises OSError: it cannot be opened.
    """

    def __init__(self, host: str, port: int, inside: tuple[str, int], origins: Collection[str]) -> None:
        self._inside, self._origins = inside, {origin.encode() for origin in origins}
        self._listening = socket.create_server((host, port), family=[socket.AF_INET, socket.AF_INET6][":" in host])
        self.port = int(self._listening.getsockname()[1])
        self._open, self._begun = 0, False
        self._tasks = Tasks()
        self._tasks.begin(self._serve())

    async def _serve(self) -> None:
        self._begun = True
        async with await asyncio.start_server(self._pass, sock=self._listening) as server:
            await server.serve_forever()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        counted = False
        with suppress(OSError, EOFError, TimeoutError, asyncio.LimitOverrunError), closing(writer):
            async with asyncio.timeout(_HEAD_S):
                head = await reader.readuntil(b"\r\n\r\n")
            self._open, counted = self._open + 1, True  # who says nothing keeps nobody out
            if self._open <= _MOST and self._origins.issuperset(_ORIGIN.findall(head)):
                answers, asks = await asyncio.open_connection(*self._inside)
                with closing(asks):
                    asks.write(head)
                    await until_one_ends(_copied(reader, asks), _copied(answers, writer))
            else:
                writer.write(_REFUSED)
        self._open -= counted

    def close(self) -> None:
        """Close the port; connections end with the server."""
        self._tasks.cancel("")
        if not self._begun:
            self._listening.close()


async def _copied(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(2**16):
        writer.write(data)
        await writer.drain()

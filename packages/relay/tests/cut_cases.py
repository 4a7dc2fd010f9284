"""A link that a test cuts and freezes: a TCP proxy before a relay, whose bytes wait while it is frozen."""

import asyncio
import contextlib
from collections.abc import AsyncIterator

from bufgym_robot.wire.tasks import Tasks, until_one_ends


class Cuttable:
    """The proxy. ``freeze`` keeps all bytes either way until ``thaw``; ``cut`` ends connections, and lets none in."""

    def __init__(self, target: int) -> None:
        self._target = target
        self._flows, self._is_cut = asyncio.Event(), False
        self._flows.set()
        self._writers: set[asyncio.StreamWriter] = set()
        self.port = 0

    def freeze(self) -> None:
        self._flows.clear()

    def thaw(self) -> None:
        self._flows.set()

    def cut(self) -> None:
        self._is_cut = True
        for writer in list(self._writers):
            writer.transport.abort()

    def mend(self) -> None:
        self._is_cut = False
        self._flows.set()

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(2**16):
            await self._flows.wait()
            writer.write(data)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._is_cut:
            writer.transport.abort()
            return
        ends = {writer}
        try:
            with contextlib.suppress(OSError):
                there, back = await asyncio.open_connection("127.0.0.1", self._target)
                ends.add(back)
                self._writers |= ends
                await until_one_ends(self._carry(reader, back), self._carry(there, writer))
        finally:
            self._writers -= ends
            for one in ends:
                one.transport.abort()


@contextlib.asynccontextmanager
async def cuttable(target: int) -> AsyncIterator[Cuttable]:
    """Such a link before the relay at the port ``target``."""
    link, tasks = Cuttable(target), Tasks()

    def met(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        tasks.begin(link._serve(reader, writer))

    server = await asyncio.start_server(met, "127.0.0.1", 0)
    link.port = server.sockets[0].getsockname()[1]
    try:
        yield link
    finally:
        server.close()
        await tasks.end()

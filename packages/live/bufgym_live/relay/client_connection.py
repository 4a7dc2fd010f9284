"""A client's connection that ends by itself where the relay has gone silent."""

import asyncio

from websockets.asyncio.client import ClientConnection

from bufgym_live.relay.wire import PING_S, PONG_S


class WatchedConnection(ClientConnection):
    """Ends where nothing has come for a ping's time and a pong's, although either end pings.

    The library's own ping waits behind a message that waits for room. A relay that stops to read would hold a client
    for ever.
    """

    heard_s = 0.0

    def data_received(self, data: bytes) -> None:
        self.heard_s = self.loop.time()
        super().data_received(data)

    async def keepalive(self) -> None:
        """Ping, and watch."""
        self.heard_s = self.loop.time()
        watch = asyncio.create_task(self._watch())
        try:
            await super().keepalive()
        finally:
            watch.cancel()

    async def _watch(self) -> None:
        most_s = (self.ping_interval or PING_S) + (self.ping_timeout or PONG_S)
        while (left_s := self.heard_s + most_s - self.loop.time()) > 0:
            await asyncio.sleep(left_s)
        self.transport.abort()

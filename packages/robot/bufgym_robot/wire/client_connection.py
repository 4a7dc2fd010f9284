"""A client's connection that ends by itself where the relay has gone silent."""

import asyncio
import ssl
from typing import Any
from urllib.parse import SplitResult

from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from bufgym_robot.wire import address
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import PING_S, PONG_S

CLOSE_S = 1.0  # Time for the relay to answer that the connection is closed


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


async def connected(to: SplitResult, tls: ssl.SSLContext | None) -> Any:
    """Connect to the relay at this address."""
    secure = to.scheme == "wss"
    return await connect(
        f"{to.scheme}://{to.netloc}{to.path.rstrip('/')}{wire.PATH}",
        sock=await address.reached(to),
        subprotocols=[Subprotocol(wire.SUBPROTOCOL)],
        ssl=(tls or ssl.create_default_context()) if secure else None,
        server_hostname=to.hostname if secure else None,
        compression=None,
        create_connection=WatchedConnection,
        ping_interval=wire.PING_S,
        ping_timeout=wire.PONG_S,
        close_timeout=CLOSE_S,
        proxy=None,
        max_size=wire.MAX_FRAME_BYTES,
        write_limit=(1, 0),
    )

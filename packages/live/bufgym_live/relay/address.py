"""Addresses of relays, as clients name them."""

import socket
from urllib.parse import SplitResult, urlsplit

from bufgym.ground.errors import BufgymError
from bufgym_live.robot.sockets import connected


def parsed(url: str) -> SplitResult:
    """Read ``ws://HOST:PORT`` or ``wss://HOST:PORT``."""
    try:
        address = urlsplit(url)
        if address.scheme in ("ws", "wss") and address.hostname and address.port != 0:
            return address
    except ValueError:  # no port, or no IPv6 address
        pass
    raise BufgymError(f"{url}: must be ws://HOST:PORT or wss://HOST:PORT")


async def reached(address: SplitResult) -> socket.socket:
    """Connect to the relay there."""
    return await connected(address.hostname or "", address.port or (443 if address.scheme == "wss" else 80))

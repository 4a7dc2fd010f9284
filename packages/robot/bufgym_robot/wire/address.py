"""How a client reaches a relay: the address, TLS, and the token that says who it is."""

import os
import socket
import ssl
from pathlib import Path
from typing import Final
from urllib.parse import SplitResult, urlsplit

from bufgym.utils.errors import BufgymError
from bufgym.utils.files import read_utf8
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.sockets import connected

TOKEN_VARIABLE: Final = "BUFGYM_RELAY_TOKEN"
_MAX_TOKEN_BYTES: Final = 2**16


def parsed(url: str) -> SplitResult:
    """Read ``ws://HOST:PORT`` or ``wss://HOST:PORT``; a path is the prefix of a proxy, with or without ``/relay``."""
    try:
        address = urlsplit(url)
        if address.scheme in ("ws", "wss") and address.hostname and address.port != 0:
            return address._replace(path=address.path.rstrip("/").removesuffix(wire.PATH))
    except ValueError:  # no port, or no IPv6 address
        pass
    raise BufgymError(f"{url}: must be ws://HOST:PORT or wss://HOST:PORT")


async def reached(address: SplitResult) -> socket.socket:
    """Connect to the relay there."""
    return await connected(address.hostname or "", address.port or (443 if address.scheme == "wss" else 80))


def token(path: str | Path | None = None) -> str | None:
    """Read the token from this file or from the environment's ``BUFGYM_RELAY_TOKEN``; None without either."""
    if path is not None:
        return read_utf8(path, _MAX_TOKEN_BYTES).strip()
    return os.environ.get(TOKEN_VARIABLE) or None


def security(authority: str | None = None, certificate: str | None = None) -> ssl.SSLContext | None:
    """Set up TLS for ``wss`` from PEM files: the relay's authority, and the client's certificate with its key."""
    if authority is None and certificate is None:
        return None
    try:
        context = ssl.create_default_context(cafile=authority)
        if certificate is not None:
            context.load_cert_chain(certificate)
    except (OSError, ssl.SSLError) as error:
        raise BufgymError(f"{certificate or authority}: no certificate: {error}") from None
    return context

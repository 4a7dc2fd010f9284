"""``bufgym relay``: a fleet's server, and a viewer."""

import sys
from functools import partial
from typing import Annotated

from cyclopts import Parameter

from bufgym.cli.options import PortNumber
from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.options import SessionOptions


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


async def serve(*, config: str, check: bool = False) -> None:
    """Run the server under a configuration; Ctrl-C ends it, SIGHUP rereads rules, keys and certificate.

    Args:
        config: As examples/relay.toml.
        check: Only read it and the files that it names, and print the first fault.
    """
    from bufgym_relay import config as configurations
    from bufgym_relay import server
    from bufgym_relay.faults import doubts

    settings = configurations.load(config)
    if check:
        try:
            server.check(settings)
        except BufgymError as error:
            raise BufgymError(f"{config}: {error}") from None
        print(f"{config}: {len(settings.rules)} rules, {settings.host}:{settings.port}")
        for doubt in doubts(settings):
            print(f"{config}: {doubt}")
        return
    await server.serve_forever(settings, partial(print, flush=True), partial(configurations.load, config))


async def foxglove(
    *,
    session: SessionOptions = SessionOptions(),
    name: str = "foxglove",
    port: Annotated[PortNumber, Parameter(help="Where they connect to.")] = 8765,
    topics: str = "^/",
    origins: list[str] | None = None,
) -> None:
    """Run a viewer that Foxglove and Lichtblick connect to; Ctrl-C ends it.

    Args:
        topics: Topics to show, a regular expression.
        origins: Other web pages that may connect, as https://lichtblick.example.org.
    """
    from bufgym_relay.foxglove import Bridge
    from bufgym_robot.wire.session import Session

    viewer = Session(session.to, name, say=say, **session.settings())
    bridge = Bridge(viewer, port, pattern=topics, origins=origins or ())
    print(f"ws://{bridge.address}: Foxglove, Lichtblick -> {session.to}; Ctrl-C ends it", flush=True)
    await bridge.run()

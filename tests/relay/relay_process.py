"""A relay in a process of its own, for tests that kill it: the port, then the folder."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from bufgym.relay.config import Config, Rule
from bufgym.relay.server import serve_forever

if __name__ == "__main__":
    config = Config(
        port=int(sys.argv[1]),
        folder=Path(sys.argv[2]),
        rules=(Rule(address="127.0.0.1", send=True, receive=True),),
        policies=("skip-pending",),
    )
    asyncio.run(serve_forever(config, lambda text: print(text, flush=True)))

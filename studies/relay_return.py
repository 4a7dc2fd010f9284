"""How soon clients are back at a relay that was killed and has started again.

python -m studies.relay_return --clients 20
python -m studies.relay_return --identities 200   # each client has an address, and so an identity, of its own

The relay is the command ``bufgym relay serve``, killed with -9 while all clients have a subscription. It comes back
after a random time within ``--away`` seconds. Printed is the time from its first line until each client's subscription
is accepted again, over all ``--kills``.
"""

import argparse
import asyncio
import contextvars
import random
import socket
import tempfile
import time
from pathlib import Path
from urllib.parse import SplitResult

import numpy as np

from bufgym_robot.wire import address as addresses
from bufgym_robot.wire.session import Session
from bufgym_robot.wire.sockets import free_port
from studies.relay_load import CONFIG, beside, served

LOCAL = contextvars.ContextVar("LOCAL", default="127.0.0.1")
"""Address that a client connects from."""


async def reached(address: SplitResult) -> socket.socket:
    """``bufgym_robot.wire.address.reached`` from ``LOCAL``."""
    one = socket.socket()
    try:
        one.setblocking(False)
        one.bind((LOCAL.get(), 0))
        await asyncio.get_running_loop().sock_connect(one, (address.hostname, address.port))
    except BaseException:
        one.close()
        raise
    return one


async def back_s(session: Session, began_s: float) -> float:
    """Time until a client's subscriptions are accepted."""
    await session.ready.wait()
    return time.monotonic() - began_s


async def returns(clients: int, identities: int, kills: int, away_s: float) -> None:
    sessions: list[Session] = []
    with tempfile.TemporaryDirectory() as folder:
        port = free_port("127.0.0.1")
        config = CONFIG.replace("port = 0", f'port = {port}\nfolder = "held"')

        async def keep(k: int) -> None:
            LOCAL.set(f"127.1.0.{1 + k % 250}" if identities else "127.0.0.1")
            await sessions[k].run()

        for k in range(identities or clients):
            sessions.append(Session(f"ws://127.0.0.1:{port}", f"client-{k}"))
            sessions[k].subscribe(f"^/robots/{k}/command$", print, durable=True)
        addresses.reached = reached
        relay, _ = await served(config, Path(folder))
        try:
            async with beside(*(keep(k) for k in range(len(sessions)))):
                times_s = []
                for _ in range(kills + 1):
                    times_s.append(await asyncio.gather(*(back_s(one, time.monotonic()) for one in sessions)))
                    if len(times_s) <= kills:
                        await asyncio.sleep(random.uniform(0.0, 8.0))
                        relay.kill()
                        await relay.wait()
                        await asyncio.sleep(random.uniform(0.0, away_s))
                        relay, _ = await served(config, Path(folder))
        finally:
            relay.kill()
            await relay.wait()
    times = np.array(times_s[1:])
    who = f"{identities} identities" if identities else f"{clients} clients of one address"
    print(f"{who}, {kills} kills: back within {np.median(times):.2f} s (median), {times.max():.2f} s (all)")
    print("the last of each kill:", *(f"{one:.2f}" for one in times.max(axis=1)), "s")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--identities", type=int, default=0, help="instead of --clients of one address")
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--away", dest="away_s", type=float, default=10.0)
    asyncio.run(returns(**vars(parser.parse_args())))


if __name__ == "__main__":
    main()

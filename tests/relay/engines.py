"""What could carry topics between relays, compared: Zenoh within the relays, or a nats-server beside each.

python tests/relay/engines.py           # Zenoh; and NATS, with nats-py and Debian's nats-server

Three nodes know the second. A program at the first publishes 50 kB at 100 Hz, another at the third receives; halfway
the second is killed (-9), and with NATS in another run the third's server, which starts again after a second.
"""

import asyncio
import contextlib
import json
import shutil
import sys
import time
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np

from bufgym.live.sockets import free_port

SIZE_BYTES, RATE_HZ, COUNT = 50_000, 100, 600
KEY = "bufgym.relay"
Publish = Callable[[bytes], Awaitable[None]]


class Heard(list[tuple[int, float]]):
    """(number, s on its way) of each message that arrived at the third."""

    def take(self, data: bytes) -> None:
        number, sent_s = data[:30].split()
        self.append((int(number), time.monotonic() - float(sent_s)))

    async def found(self, publish: Publish, name: str) -> None:
        """Publish until something arrives."""
        began_s = time.monotonic()
        while not self:
            await publish(f"{0:08} {0:020.9f} ".encode())
            await asyncio.sleep(0.01)
        print(f"{name}: three nodes have found each other in {time.monotonic() - began_s:.2f} s")
        await asyncio.sleep(1.0)

    async def measure(self, name: str, publish: Publish, halfway: Callable[[], Any]) -> None:
        self.clear()
        began_s = time.monotonic()
        for number in range(COUNT):
            if number == COUNT // 2:
                halfway()
            await asyncio.sleep(max(0.0, began_s + number / RATE_HZ - time.monotonic()))
            await publish(f"{number:08} {time.monotonic():020.9f} ".encode().ljust(SIZE_BYTES, b"x"))
        await asyncio.sleep(2.0)
        median, late = np.percentile([late_s for _, late_s in self], [50, 99]) * 1e3
        lost = COUNT - len({number for number, _ in self})
        print(f"{name}: {median:.2f} ms, p99 {late:.1f}; lost {lost} of {COUNT}", flush=True)


def node(port: int, *known: int) -> Any:
    """One of Zenoh's."""
    import zenoh

    config = zenoh.Config()
    for key, setting in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "connect/endpoints": [f"tcp/127.0.0.1:{each}" for each in known],
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(setting))
    return zenoh.open(config)


async def zenoh() -> None:
    ports, heard = [free_port("127.0.0.1") for _ in range(3)], Heard()
    second = await asyncio.create_subprocess_exec(sys.executable, __file__, "--node", str(ports[1]), stdout=-1)
    assert second.stdout is not None
    await second.stdout.readline()
    first, third = node(ports[0], ports[1]), node(ports[2], ports[1])
    third.declare_subscriber(KEY, lambda sample: heard.take(sample.payload.to_bytes()))

    async def publish(data: bytes) -> None:
        first.put(KEY, data, express=True)

    await heard.found(publish, "Zenoh")
    await heard.measure("Zenoh, the second killed", publish, second.kill)
    first.close()
    third.close()


async def nats() -> None:
    import nats

    ports, routes = ([free_port("127.0.0.1") for _ in range(3)] for _ in range(2))
    servers: list[Any] = [None] * 3
    heard, clients = Heard(), []

    async def start(k: int) -> None:
        words = ["-a", "127.0.0.1", "-p", str(ports[k]), "--cluster_name", "fleet"]
        words += ["--cluster", f"nats://127.0.0.1:{routes[k]}", "--routes", f"nats://127.0.0.1:{routes[1]}"]
        servers[k] = await asyncio.create_subprocess_exec("nats-server", *words, stderr=asyncio.subprocess.DEVNULL)

    for k in (1, 0, 2):
        await start(k)
    for k in (0, 2):
        while len(clients) < 1 + k // 2:
            with contextlib.suppress(OSError, nats.errors.Error):
                url, retry = f"nats://127.0.0.1:{ports[k]}", {"reconnect_time_wait": 0.2, "max_reconnect_attempts": -1}
                clients.append(await nats.connect(url, **retry))
            await asyncio.sleep(0.02)

    async def take(message: Any) -> None:
        heard.take(message.data)

    async def publish(data: bytes) -> None:
        await clients[0].publish(KEY, data)
        await clients[0].flush()

    def again() -> None:
        servers[2].kill()
        asyncio.get_running_loop().call_later(1.0, lambda: asyncio.ensure_future(start(2)))

    await clients[1].subscribe(KEY, cb=take)
    await heard.found(publish, "NATS")
    await heard.measure("NATS, the second killed", publish, servers[1].kill)
    await start(1)
    await asyncio.sleep(1.0)
    await heard.measure("NATS, the server beside the third killed", publish, again)
    for client in clients:
        await client.close()
    for server in servers:
        server.kill()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--node"]:
        session = node(int(sys.argv[2]))
        print("here", flush=True)
        time.sleep(3_600)
    asyncio.run(zenoh())
    if shutil.which("nats-server") is None:
        sys.exit("no nats-server here: apt-get install nats-server")
    asyncio.run(nats())

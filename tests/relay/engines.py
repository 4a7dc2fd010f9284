"""What could carry topics between relays, compared: Zenoh within the relays, or a nats-server beside each.

python tests/relay/engines.py           # Zenoh; and NATS, with nats-py and Debian's nats-server

Three nodes know the second. A program at the first publishes 50 kB at 100 Hz, another at the third receives; halfway
the second is killed (-9), and with NATS in another run the third's server, which starts again after a second.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import signal
import sys
import time
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np

from bufgym.live.sockets import free_port

SIZE_BYTES, RATE_HZ, COUNT = 50_000, 100, 600
KEY = "bufgym.relay"

Publish = Callable[[bytes], Awaitable[None]]


def zenoh_session(port: int, *known: int) -> Any:
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


async def measured(name: str, publish: Publish, took: list[tuple[int, float]], halfway: Callable[[], Any]) -> None:
    """``took`` gets (number, s) of what arrives."""
    took.clear()
    began_s = time.monotonic()
    for number in range(COUNT):
        if number == COUNT // 2:
            halfway()
        await asyncio.sleep(max(0.0, began_s + number / RATE_HZ - time.monotonic()))
        head = f"{number:08} {time.monotonic():020.9f} ".encode()
        await publish(head.ljust(SIZE_BYTES, b"x"))
    await asyncio.sleep(2.0)
    median, late = np.percentile([late_s for _, late_s in took], [50, 99]) * 1e3
    lost = COUNT - len({number for number, _ in took})
    print(f"{name}: {median:.2f} ms, p99 {late:.1f}; lost {lost} of {COUNT}", flush=True)


def heard(data: bytes) -> tuple[int, float]:
    number, sent_s = data[:30].split()
    return int(number), time.monotonic() - float(sent_s)


async def zenoh() -> None:
    ports = [free_port("127.0.0.1") for _ in range(3)]
    second = await asyncio.create_subprocess_exec(sys.executable, __file__, "--node", str(ports[1]), stdout=-1)
    assert second.stdout is not None
    await second.stdout.readline()
    began_s = time.monotonic()
    first, third = zenoh_session(ports[0], ports[1]), zenoh_session(ports[2], ports[1])
    took: list[tuple[int, float]] = []
    third.declare_subscriber(KEY, lambda sample: took.append(heard(sample.payload.to_bytes())))

    async def publish(data: bytes) -> None:
        first.put(KEY, data, express=True)

    while not took:
        await publish(f"{0:08} {0:020.9f} ".encode())
        await asyncio.sleep(0.01)
    print(f"Zenoh: three nodes have found each other in {time.monotonic() - began_s:.2f} s")
    await asyncio.sleep(1.0)
    await measured("Zenoh, the second killed", publish, took, second.kill)
    await second.wait()
    first.close()
    third.close()


async def nats() -> None:
    import nats

    ports, routes = ([free_port("127.0.0.1") for _ in range(3)] for _ in range(2))
    servers: list[Any] = [None] * 3

    async def start(k: int) -> None:
        words = ["-a", "127.0.0.1", "-p", str(ports[k]), "--cluster_name", "fleet"]
        words += ["--cluster", f"nats://127.0.0.1:{routes[k]}", "--routes", f"nats://127.0.0.1:{routes[1]}"]
        servers[k] = await asyncio.create_subprocess_exec("nats-server", *words, stderr=asyncio.subprocess.DEVNULL)

    began_s = time.monotonic()
    for k in (1, 0, 2):
        await start(k)
    clients = []
    for k in (0, 2):
        while True:
            with contextlib.suppress(OSError, nats.errors.Error):
                clients.append(
                    await nats.connect(
                        f"nats://127.0.0.1:{ports[k]}", reconnect_time_wait=0.2, max_reconnect_attempts=-1
                    )
                )
                break
            await asyncio.sleep(0.02)
    took: list[tuple[int, float]] = []

    async def take(message: Any) -> None:
        took.append(heard(message.data))

    await clients[1].subscribe(KEY, cb=take)

    async def publish(data: bytes) -> None:
        await clients[0].publish(KEY, data)
        await clients[0].flush()

    while not took:
        await publish(f"{0:08} {0:020.9f} ".encode())
        await asyncio.sleep(0.01)
    print(f"NATS: three nodes have found each other in {time.monotonic() - began_s:.2f} s")
    await asyncio.sleep(1.0)
    await measured("NATS, the second killed", publish, took, servers[1].kill)
    await servers[1].wait()

    def again() -> None:
        servers[2].send_signal(signal.SIGKILL)
        asyncio.get_running_loop().call_later(1.0, lambda: asyncio.ensure_future(start(2)))

    await start(1)
    await asyncio.sleep(1.0)
    await measured("NATS, the server beside the third killed", publish, took, again)
    for client in clients:
        await client.close()
    for server in servers:
        server.kill()
        await server.wait()


async def node(port: int) -> None:
    session = zenoh_session(port)
    print("here", flush=True)
    await asyncio.Event().wait()
    session.close()


def main() -> None:
    if sys.argv[1:2] == ["--node"]:
        asyncio.run(node(int(sys.argv[2])))
        return
    asyncio.run(zenoh())
    if shutil.which("nats-server") is None:
        print("no nats-server here: apt-get install nats-server")
        return
    asyncio.run(nats())


if __name__ == "__main__":
    main()

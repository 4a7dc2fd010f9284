"""The same messages through a relay, a NATS server and an MQTT broker: processor time a delivery, and memory.

python -m studies.relay_others --robots 20 --viewers 5 --seconds 20
python -m studies.relay_others --bytes 1000 --only relay

Each robot sends pictures of 50 kB ten times a second, each viewer gets all of them. Clients share this process; only
the server's own process is counted. Needs nats-server and mosquitto.
"""

import argparse
import asyncio
import contextlib
import os
import shutil
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from studies.relay_load import RATE_HZ, SIZE_BYTES, cpu_s, each, megabytes, relay

from relay_cases import client  # isort: skip  (relay_load has made it known)

from bufgym_robot.wire.sockets import free_port

Publish = Callable[[int, bytes], Awaitable[None]]
Ends = Callable[[int, Callable[[], None]], Any]


@contextlib.asynccontextmanager
async def program(*words: str) -> AsyncIterator[int]:
    name = shutil.which(words[0]) or shutil.which(words[0], path="/usr/sbin")
    if name is None:
        raise SystemExit(f"no {words[0]} here")
    quiet = asyncio.subprocess.DEVNULL
    one = await asyncio.create_subprocess_exec(name, *words[1:], stdout=quiet, stderr=quiet)
    try:
        await asyncio.sleep(1.0)
        yield one.pid
    finally:
        one.kill()
        await one.wait()


@contextlib.asynccontextmanager
async def over_relay(viewers: int, heard: Callable[[], None]) -> AsyncIterator[tuple[int, Publish]]:
    async with relay() as (pid, port), contextlib.AsyncExitStack() as stack:

        async def view(one: Any) -> None:
            while True:
                await one.socket.recv()
                heard()

        running = []
        for _ in range(viewers):
            one = await stack.enter_async_context(client(port))
            await one.subscribe("^/robots/")
            running.append(asyncio.create_task(view(one)))
        robots: dict[int, Any] = {}

        async def publish(k: int, data: bytes) -> None:
            if k not in robots:
                robots[k] = await stack.enter_async_context(client(port))
            await robots[k].put(f"/robots/{k}/camera", data)

        yield pid, publish
        for task in running:
            task.cancel()


@contextlib.asynccontextmanager
async def over_nats(viewers: int, heard: Callable[[], None]) -> AsyncIterator[tuple[int, Publish]]:
    import nats

    port = free_port("127.0.0.1")
    async with program("nats-server", "-a", "127.0.0.1", "-p", str(port)) as pid:

        async def take(message: Any) -> None:
            heard()

        ends = [await nats.connect(f"nats://127.0.0.1:{port}") for _ in range(viewers)]
        for one in ends:
            await one.subscribe("robots.>", cb=take)
        robots: dict[int, Any] = {}

        async def publish(k: int, data: bytes) -> None:
            if k not in robots:
                robots[k] = await nats.connect(f"nats://127.0.0.1:{port}")
            await robots[k].publish(f"robots.{k}.camera", data)

        yield pid, publish
        for one in [*ends, *robots.values()]:
            await one.close()


@contextlib.asynccontextmanager
async def over_mqtt(viewers: int, heard: Callable[[], None]) -> AsyncIterator[tuple[int, Publish]]:
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    port, lock = free_port("127.0.0.1"), threading.Lock()

    def take(*_: Any) -> None:
        with lock:
            heard()

    def connected() -> Client:
        one = Client(CallbackAPIVersion.VERSION2)
        one.connect("127.0.0.1", port)
        one.loop_start()
        return one

    async with program("mosquitto", "-p", str(port)) as pid:
        ends = [connected() for _ in range(viewers)]
        for one in ends:
            one.on_message = take
            one.subscribe("robots/#")
        robots: dict[int, Client] = {}

        async def publish(k: int, data: bytes) -> None:
            if k not in robots:
                robots[k] = connected()
            robots[k].publish(f"robots/{k}/camera", data)

        await asyncio.sleep(0.5)
        yield pid, publish
        for one in [*ends, *robots.values()]:
            one.disconnect()
            one.loop_stop()


SERVERS: dict[str, Any] = {"relay": over_relay, "nats-server": over_nats, "mosquitto": over_mqtt}


async def measure(name: str, robots: int, viewers: int, seconds: float, size_bytes: int) -> None:
    count, data = 0, os.urandom(size_bytes)

    def heard() -> None:
        nonlocal count
        count += 1

    async with SERVERS[name](viewers, heard) as (pid, publish):

        async def drive(k: int, seconds: float) -> None:
            async for _ in each(RATE_HZ, round(seconds * RATE_HZ), k / robots / RATE_HZ):
                await publish(k, data)

        await asyncio.gather(*(drive(k, 1.0) for k in range(robots)))  # all are connected, all is warm
        await asyncio.sleep(0.5)
        began, count = cpu_s(pid), 0
        await asyncio.gather(*(drive(k, seconds) for k in range(robots)))
        await asyncio.sleep(0.5)
        cost_us = 1e6 * (cpu_s(pid) - began) / max(count, 1)
        of = robots * viewers * round(seconds * RATE_HZ)
        print(f"{name:12} {count} of {of} delivered, {cost_us:.0f} us of CPU each, {megabytes(pid):.0f} MB", flush=True)


async def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--viewers", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--bytes", dest="size_bytes", type=int, default=SIZE_BYTES)
    parser.add_argument("--only", nargs="+", choices=SERVERS, default=list(SERVERS))
    options = vars(parser.parse_args())
    for name in options.pop("only"):
        await measure(name, **options)


if __name__ == "__main__":
    asyncio.run(main())

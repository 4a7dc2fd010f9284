"""How fast a relay is: robots that publish to viewers of all, or connections that do nothing.

python tests/relay/load.py --robots 20 --viewers 5 --seconds 60 [--slow]
python tests/relay/load.py --idle 1000

The relay has a process of its own; robots and viewers share another. So that this measures the relay and not them,
robots send frames that are made beforehand, and viewers read no more of a frame than its header.
"""

import argparse
import asyncio
import contextlib
import os
import struct
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from relay_cases import client, settings

from bufgym.relay import wire
from bufgym.relay.config import Limits
from bufgym.relay.server import serve_forever
from bufgym.relay.wire import Message

SIZE_BYTES, RATE_HZ, MEMORY_S = 50_000, 10, 30.0
_BINARY, _PING, _PONG, _MASKED = 0x82, 0x89, 0x8A, 0x80
_HEAD_BYTES = 10 + 32
"""Of a WebSocket's frame, at most, and of a message with its stamp."""


class Relay:
    """The process, and what it takes."""

    def __init__(self, process: Any, port: int) -> None:
        self.process, self.port, self.proc = process, port, Path(f"/proc/{process.pid}")

    @classmethod
    @contextlib.asynccontextmanager
    async def started(cls) -> Any:
        process = await asyncio.create_subprocess_exec(sys.executable, __file__, "--serve", stdout=-1)
        assert process.stdout is not None
        line = (await process.stdout.readline()).decode()
        try:
            yield cls(process, int(line.partition("/ is")[0].rpartition(":")[2]))
        finally:
            process.kill()
            await process.wait()

    @property
    def cpu_s(self) -> float:
        times = (self.proc / "stat").read_text().rpartition(")")[2].split()
        return (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")

    @property
    def megabytes(self) -> float:
        return int((self.proc / "statm").read_text().split()[1]) * 4096 / 1e6


async def idle(count: int) -> None:
    async with Relay.started() as relay, contextlib.AsyncExitStack() as stack:
        times_s, before = [], relay.megabytes
        for _ in range(count):
            began_s = time.perf_counter()
            one = await stack.enter_async_context(client(relay.port))
            await one.subscribe("^/robots/")
            times_s.append(time.perf_counter() - began_s)
        median, late = np.percentile(times_s, [50, 99]) * 1e3
        memory = f"{before:.0f} -> {relay.megabytes:.0f} MB"
        print(f"{count} connections: {memory}; {median:.1f} ms a new one, p99 {late:.1f}")


class Viewer(asyncio.BufferedProtocol):
    """Takes frames off a connection that ``client`` has made; ``latency_us`` gets that of each message."""

    def __init__(self, transport: Any, latency_us: list[int]) -> None:
        self.latency_us = latency_us
        self._buffer, self._end, self._skip = bytearray(2**18), 0, 0
        self._transport = transport
        transport.set_protocol(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        return memoryview(self._buffer)[self._end :]

    def buffer_updated(self, nbytes: int) -> None:
        self._end += nbytes
        at = 0
        while True:
            skipped = min(self._skip, self._end - at)
            self._skip -= skipped
            at += skipped
            head = self._buffer[at : min(at + _HEAD_BYTES, self._end)]
            if self._skip or not (length := self._frame(head)):
                break
            self._skip = length
        left = self._buffer[at : self._end]
        self._buffer[: len(left)] = left
        self._end = len(left)

    def _frame(self, head: bytearray) -> int:
        """Bytes of the frame that begins so; 0 if too little of it is here."""
        kind, size, at = head[0] if head else 0, head[1] if len(head) > 1 else 0, 2
        if size >= 126:
            form, at = ("!H", 4) if size == 126 else ("!Q", 10)
            if len(head) < at:
                return 0
            (size,) = struct.unpack_from(form, head, 2)
        if len(head) < max(2, min(at + size, at + 32)):
            return 0
        if kind == _BINARY:
            self.latency_us.append(time.time_ns() // 1000 - int(struct.unpack_from("!q", head, at + 24)[0]))
        elif kind == _PING:
            self._transport.write(bytes([_PONG, _MASKED | size]) + bytes(4) + head[at : at + size])
        return at + size


async def view(port: int, slowly: bool, latency_us: list[int]) -> None:
    async with client(port, receive_buffer_bytes=65_536 if slowly else None, name="viewer") as one:
        await one.subscribe("^/robots/")
        if not slowly:
            Viewer(one.socket.transport, latency_us)
            await asyncio.Event().wait()
        while True:
            message = await one.next()
            if isinstance(message, Message):
                latency_us.append(time.time_ns() // 1000 - message.stamp_us)
                await asyncio.sleep(SIZE_BYTES / 1e5)


async def publish(port: int, k: int, robots: int, seconds: float) -> None:
    """Frames with 0 for a mask, of which only the stamp changes."""
    data = wire.encode(Message(f"/robots/{k}/camera", os.urandom(SIZE_BYTES), "raw"))
    frame = bytearray(bytes([_BINARY, _MASKED | 127]) + struct.pack("!Q", len(data)) + bytes(4) + data)
    async with client(port, name=f"robot-{k}") as one:
        await asyncio.sleep(k / robots / RATE_HZ)
        began_s = time.monotonic()
        for i in range(round(seconds * RATE_HZ)):
            await asyncio.sleep(max(0.0, began_s + i / RATE_HZ - time.monotonic()))
            struct.pack_into("!q", frame, 14 + 24, time.time_ns() // 1000)
            one.socket.transport.write(bytes(frame))


async def watch(relay: Relay, memory_mb: list[float]) -> None:
    while True:
        await asyncio.sleep(MEMORY_S)
        memory_mb.append(relay.megabytes)


async def busy(robots: int, viewers: int, seconds: float, slow: bool) -> None:
    latency_us: list[list[int]] = [[] for _ in range(viewers)]
    memory_mb: list[float] = []
    async with Relay.started() as relay:
        views = [view(relay.port, slow and k == 0, latency_us[k]) for k in range(viewers)]
        beside = [asyncio.create_task(work) for work in (*views, watch(relay, memory_mb))]
        await asyncio.sleep(5.0)  # until the policy is compiled
        began_s, cpu_s, before = time.monotonic(), relay.cpu_s, relay.megabytes
        await asyncio.gather(*(publish(relay.port, k, robots, seconds) for k in range(robots)))
        cores = (relay.cpu_s - cpu_s) / (time.monotonic() - began_s)
        await asyncio.sleep(1.0)
        for task in beside:
            task.cancel()
        print(f"{robots} robots, {viewers} viewers: {cores:.2f} cores, {before:.0f} -> {relay.megabytes:.0f} MB")
    print(f"every {MEMORY_S:g} s: {' '.join(f'{mb:.0f}' for mb in memory_mb)} MB")
    for k, times_us in enumerate(latency_us):
        median, late, longest = np.percentile(times_us, [50, 99, 100]) / 1e3
        of = round(seconds * RATE_HZ) * robots
        print(f"viewer {k}: {len(times_us)} of {of}, {median:.2f} ms, p99 {late:.2f}, longest {longest:.0f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--viewers", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--slow", action="store_true", help="the first viewer reads 100 kB/s")
    parser.add_argument("--idle", type=int, default=0)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        many = Limits(connections=10_000, all_connections=10_000, sessions=10_000, subscriptions=10_000)
        asyncio.run(serve_forever(settings(policies=("robofleet",), limits=many), lambda text: print(text, flush=True)))
    elif options.idle:
        asyncio.run(idle(options.idle))
    else:
        asyncio.run(busy(options.robots, options.viewers, options.seconds, options.slow))


if __name__ == "__main__":
    main()

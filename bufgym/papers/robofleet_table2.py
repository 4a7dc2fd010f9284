"""Table II of the Robofleet paper: CPU and memory of a client with 1 to 5 topics.

We run real programs: our client at our relay, and a client that sends JSON over a WebSocket as rosbridge does. Each is
a process of its own. A third process makes the same messages and sends nothing, so that the cost of Python can be told
from the cost of sending. The relay and the reader of the JSON run in this process and are not counted. The paper uses
other programs, messages and rates.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

from bufgym.ground.errors import BufgymError
from bufgym.papers.encodings import content, encode
from bufgym.papers.extra import library
from bufgym.papers.figure import COLOURS, Figure, finish, legend_below, several, whole
from bufgym.papers.rows import Rows, listed

TOPICS: Final = ("LaserScan", "CompressedImage", "NavSatFix", "PoseStamped", "Odometry")
"""Kind of message on each topic."""
PROGRAMS: Final = {
    "bufgym": ("our client", COLOURS["afr"]),
    "json": ("JSON, rosbridge's way", COLOURS["random"]),
    "nothing": ("sends nothing", COLOURS["other"]),
}
"""Program -> label and colour."""
_SETTLE_S: Final = 2.0
"""Time before counting begins, for connections and for code to be compiled or loaded from a cache."""
_START_S: Final = 120.0
_BYTES: Final = 2**20


@dataclass(frozen=True)
class Reproduction(Figure):
    """Table II, measured."""

    topics: Sequence[int] = (1, 2, 3, 4, 5)
    rate_hz: int = 10
    """Rate of each topic."""
    seconds: int = 8
    """Seconds counted of each run."""
    runs: int = 1

    SIZE_INCHES = (9.0, 4.0)
    RULES = {"topics": several(whole(1, len(TOPICS))), "rate_hz": whole(1, 1000), "seconds": whole(1, 3600)}

    def simulate(self) -> Rows:
        rows = Rows()
        for count, program, number in product(self.topics, PROGRAMS, range(self.runs)):
            found = asyncio.run(self._measured(program, count))
            rows.append({"program": program, "topics": count, "run": number, **found})
        return rows

    async def _measured(self, program: str, count: int) -> dict[str, float]:
        """Run one process; return the costs that it reports."""
        async with {"bufgym": _relay, "json": _sink, "nothing": _nobody}[program]() as port:
            words = [program, str(port), str(count), str(self.rate_hz), str(self.seconds)]
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", __name__, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
            try:
                async with asyncio.timeout(_START_S + _SETTLE_S + self.seconds):
                    said, fault = await process.communicate()
            except TimeoutError:
                process.kill()
                raise BufgymError(f"robofleet-table2: {program} does not end") from None
        if process.returncode:
            raise BufgymError(f"robofleet-table2: {program}: {fault.decode(errors='replace').strip()[-200:]}")
        found: dict[str, float] = json.loads(said)
        return found

    def tables(self, rows: Rows) -> list[str]:
        labels = {name: label for name, (label, _) in PROGRAMS.items()}
        return [
            "CPU, % of a core, by topics; then memory, MB:",
            *rows.pivot("program", "topics", "cpu_percent", ".1f", labels),
            *rows.pivot("program", "topics", "memory_mb", ".0f", labels),
        ]

    def claims(self, rows: Rows) -> dict[str, Any]:
        def means(name: str, column: str) -> list[float]:
            return [rows.mean(column, program=name, topics=count) for count in self.topics]

        facts: dict[str, Any] = {"counts": listed(list(self.topics))}
        for column, claim, spec in (("cpu_percent", "cpu", ".1f"), ("memory_mb", "memory", ".0f")):
            facts |= {
                f"{name}_{claim}": listed([f"{number:{spec}}" for number in means(name, column)]) for name in PROGRAMS
            }
            ours, theirs = means("bufgym", column), means("json", column)
            facts[claim] = all(a <= b for a, b in zip(ours, theirs, strict=True))
        facts["arrived"] = min(rows.column("sent_share"))
        return facts

    def draw(self, rows: Rows, figure: Any) -> None:
        labels = {"cpu_percent": "CPU, % of a core", "memory_mb": "memory, MB"}
        panels = figure.subplots(1, 2)
        for axes, (column, label) in zip(panels, labels.items(), strict=True):
            for name, (text, colour) in PROGRAMS.items():
                means = [rows.mean(column, program=name, topics=count) for count in self.topics]
                axes.plot(list(self.topics), means, "o-", color=colour, label=text)
            axes.set_ylim(bottom=0)
            axes.set_xticks(list(self.topics))
            finish(axes, label, xlabel="topics")
        legend_below(figure, 3, panels[0])


# --- what they send to -----------------------------------------------------------------------------------------------


@asynccontextmanager
async def _relay() -> AsyncIterator[int]:
    """Serve our relay; yields its port."""
    from bufgym.relay.config import Config, Rule
    from bufgym.relay.server import Server

    server = Server(Config(port=0, rules=(Rule(address="127.0.0.1", send=True),)))
    yield await server.start()
    await server.close()


@asynccontextmanager
async def _sink() -> AsyncIterator[int]:
    """Serve a reader that discards; yields its port."""

    async def read(socket: Any) -> None:
        async for _ in socket:
            pass

    serve = library("websockets.asyncio.server", "relay").serve
    async with serve(read, "127.0.0.1", 0, compression=None, max_size=2**26) as server:
        yield int(next(iter(server.sockets)).getsockname()[1])


@asynccontextmanager
async def _nobody() -> AsyncIterator[int]:
    yield 0


# --- the processes ---------------------------------------------------------------------------------------------------


def name_of(number: int) -> str:
    """Name a topic."""
    return f"/robots/robot/{number}"


async def _client(program: str, port: int, count: int, rate_hz: float, seconds: float) -> dict[str, float]:
    """Publish, then report the cost."""
    messages = [content(kind) for kind in TOPICS[:count]]
    binary = [encode(kind, message, "ros1") for kind, message in zip(TOPICS, messages, strict=False)]
    if program == "bufgym":
        from bufgym.model.topics import Topic
        from bufgym.relay.client import Client

        client = Client(f"ws://127.0.0.1:{port}", "robot", topics=[Topic(name_of(k)) for k in range(count)])
        running = asyncio.create_task(client.run())
        await client.connected.wait()

        async def send(number: int) -> None:
            client.publish(name_of(number), binary[number], "ros1", TOPICS[number])
    elif program == "json":
        from websockets.asyncio.client import connect

        socket = await connect(f"ws://127.0.0.1:{port}", compression=None, proxy=None)

        async def send(number: int) -> None:
            text = encode(TOPICS[number], messages[number], "json", name_of(number)).decode()
            await socket.send(text)
    else:

        async def send(number: int) -> None:
            pass

    sent = await _publish(send, count, rate_hz, _SETTLE_S)
    cpu_s, began_s = time.process_time(), time.monotonic()
    sent = await _publish(send, count, rate_hz, seconds)
    cpu_s, wall_s = time.process_time() - cpu_s, time.monotonic() - began_s
    share = sent / (count * rate_hz * seconds)
    if program == "bufgym":
        share -= client.queue.dropped / (count * rate_hz * (_SETTLE_S + seconds))
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    elif program == "json":
        await socket.close()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    memory_mb = pages * os.sysconf("SC_PAGE_SIZE") / _BYTES
    return {"cpu_percent": 100 * cpu_s / wall_s, "memory_mb": memory_mb, "sent_share": share}


async def _publish(send: Callable[[int], Awaitable[None]], count: int, rate_hz: float, seconds: float) -> int:
    began_s, sent = time.monotonic(), 0
    for turn in range(round(seconds * rate_hz)):
        await asyncio.sleep(max(0.0, began_s + turn / rate_hz - time.monotonic()))
        for number in range(count):
            await send(number)
            sent += 1
    return sent


if __name__ == "__main__":
    program, *numbers = sys.argv[1:]
    port, count, rate_hz, seconds = map(int, numbers)
    print(json.dumps(asyncio.run(_client(program, port, count, rate_hz, seconds))))

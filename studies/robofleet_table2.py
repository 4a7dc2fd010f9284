"""Table II of the Robofleet paper: what sending a point cloud ten times a second costs, measured.

The paper [sikand2021robofleet] plays 15 s of PointCloud2 messages at 10 Hz to a client, Robofleet's or RosLibPy, and
measures CPU time over wall-clock time and virtual memory, ten times. We run the same. RosLibPy is the real one.
Robofleet's client is written in C++ and is not at hand: bufgym's sender with Robofleet's rule takes its
place. The messages are made up, as the paper's recording is not published.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.utils.errors import BufgymError
from bufgym.utils.files import PACKAGE
from bufgym.utils.libraries import library
from bufgym.utils.tables import aligned
from bufgym_papers.figures.figure import COLOURS, Figure, finish, whole
from bufgym_papers.figures.robofleet_evaluation import POINTS
from bufgym_papers.figures.rows import FigureRows
from studies import table2_programs
from studies.encodings import content, encode

PROGRAMS = {"robofleet": "Robofleet", "rosbridge": "RosLibPy"}  # Program -> its label
PAPER = {"robofleet": ((1.3, 452.5), (15.1, 425.6)), "rosbridge": ((16.6, 1_339.6), (155.9, 732.9))}
"""Program -> (CPU of a core in %, virtual memory in MB) on the desktop's i7 and on the Jetson TX2."""
START_S = 120.0  # Time for a program to connect; the first one compiles its policy


@dataclass(frozen=True)
class Reproduction(Figure):
    """Table II; the defaults are the paper's."""

    runs: int = 10
    seconds: float = 15.0
    hz: float = 10.0
    points: int = POINTS  # points of a cloud, 16 bytes each; the paper gives no size

    RULES = {"points": whole(1, 10**6)}

    def simulate(self) -> FigureRows:
        if not sys.platform.startswith("linux"):
            raise BufgymError("robofleet-table2: virtual memory is read from /proc, which this system does not have")
        for name in ("roslibpy", "rosbags", "flatbuffers", "websockets"):
            library(name, "bufgym-robot[rosbridge]", "robofleet-table2")
        return asyncio.run(self._measure())

    async def _measure(self) -> FigureRows:
        cloud = encode("PointCloud2", content("PointCloud2", points=self.points), "ros1")
        rows = FigureRows()
        for run in range(self.runs):
            for program, server in (("robofleet", _receiver), ("rosbridge", _rosbridge)):
                async with server() as (port, received):
                    costs = await self._run(program, port, cloud)
                    rows.append({"program": program, "run": run, **costs, "received": len(received)})
        return rows

    async def _run(self, program: str, port: int, cloud: bytes) -> dict[str, float]:
        """Play the clouds to a program; return its costs."""
        words = [sys.executable, table2_programs.__file__, program, str(port)]
        here = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
        pipe = asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(*words, stdin=pipe, stdout=pipe, stderr=pipe, env=here)
        assert process.stdin is not None and process.stdout is not None and process.stderr is not None
        try:
            async with asyncio.timeout(START_S):
                if await process.stdout.readline() != b"ready\n":
                    lines = (await process.stderr.read()).decode().splitlines()
                    raise BufgymError(f"robofleet-table2: {program}: {lines[-1] if lines else 'ended at once'}")
            began_s = asyncio.get_running_loop().time()
            for k in range(round(self.seconds * self.hz)):
                await asyncio.sleep(max(0.0, began_s + k / self.hz - asyncio.get_running_loop().time()))
                process.stdin.write(len(cloud).to_bytes(4, "little") + cloud)
            await asyncio.sleep(1 / self.hz)
            process.stdin.close()
            async with asyncio.timeout(START_S):
                said: dict[str, float] = json.loads(await process.stdout.readline())
                await process.wait()  # it sends the rest
        finally:
            if process.returncode is None:
                process.kill()
            await process.wait()
        return said

    def tables(self, rows: FigureRows) -> list[str]:
        lines = [["", "CPU of a core", "virtual memory", "resident", "received", "paper, i7", "paper, Jetson TX2"]]
        for program, label in PROGRAMS.items():
            cells = [
                f"{100 * cpu.mean():.1f} ± {100 * cpu.std():.1f} %" for cpu in [rows.column("cpu", program=program)]
            ]
            for name in ("virtual_mb", "resident_mb"):
                numbers = rows.column(name, program=program)
                cells.append(f"{numbers.mean():,.1f} ± {numbers.std():.1f} MB")
            cells.append(f"{rows.mean('received', program=program):.0f} of {round(self.seconds * self.hz)}")
            lines.append([label, *cells, *(f"{cpu} %, {mb:,} MB" for cpu, mb in PAPER[program])])
        return aligned(lines)

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        ours, theirs = (rows.column("cpu", program=program) for program in PROGRAMS)
        facts: dict[str, Any] = {"cpu": bool(3 * ours.max() <= theirs.min())}
        facts["cpu_ratio"] = f"{theirs.mean() / ours.mean():.1f}"
        for program in PROGRAMS:
            facts[f"{program}_cpu"] = f"{rows.mean('cpu', program=program):.1%}"
            facts[f"{program}_mb"] = f"{rows.mean('virtual_mb', program=program):,.0f} MB"
        return facts

    def draw(self, rows: FigureRows, figure: Any) -> None:
        panels = (("cpu", 100, 0, "% of a core"), ("virtual_mb", 1, 1, "MB of virtual memory"))
        for axes, (name, factor, k, label) in zip(figure.subplots(1, 2), panels, strict=True):
            for x, program in enumerate(PROGRAMS):
                numbers = factor * rows.column(name, program=program)
                colour = COLOURS["afr" if program == "robofleet" else "drop-oldest"]
                axes.bar(x, numbers.mean(), 0.6, yerr=numbers.std(), color=colour)
                for place, marker in zip(PAPER[program], "ox", strict=True):
                    axes.plot(x, place[k], marker, color=COLOURS["oracle-ideal"])
            axes.set_xticks(np.arange(len(PROGRAMS)), ["bufgym, for Robofleet", PROGRAMS["rosbridge"]])
            finish(axes, label + (" (o, x: paper's i7, TX2)" if k == 0 else ""))


@contextlib.asynccontextmanager
async def _receiver() -> AsyncIterator[tuple[int, list[Any]]]:
    """The other end of our sender; gives its port and the list of received messages."""
    from bufgym_robot.receiver import Receiver

    came: list[Any] = []
    receiver = Receiver(lambda message: came.append(message.seq))
    try:
        yield await receiver.listen(0, transport="websocket"), came
    finally:
        await receiver.close()


@contextlib.asynccontextmanager
async def _rosbridge() -> AsyncIterator[tuple[int, list[Any]]]:
    """A server that takes rosbridge's JSON; gives the same."""
    from websockets.asyncio.server import serve
    from websockets.exceptions import ConnectionClosed

    came: list[Any] = []

    async def take(socket: Any) -> None:
        with contextlib.suppress(ConnectionClosed):
            async for text in socket:
                if '"publish"' in text[:200]:
                    came.append(table2_programs.TOPIC)

    async with serve(take, "127.0.0.1", 0, max_size=None, compression=None) as server:
        yield next(iter(server.sockets)).getsockname()[1], came

"""A relay with made-up robots over fading links, all in one process: something to look at within seconds."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Final

from bufgym.model.link import Link
from bufgym.policies import registry
from bufgym.policies.registry import Policy
from bufgym.relay import policies
from bufgym.relay.config import Config, Rule
from bufgym.relay.madeup import CONFIG, MadeUp
from bufgym.relay.robot import Robot
from bufgym.relay.server import Server
from bufgym.robot.shaped import ShapedLink
from bufgym.scenario import read_client
from bufgym.traces import Trace

CLEAR_BPS: Final = 1_000_000
FADED_BPS: Final = 100_000
"""A robot wants 550 kbit/s."""
FADES_S: Final = 24.0
PATIENCE_S: Final = 3.0
"""Until the wait for the compiler is explained."""
DELAY_US: Final = 20_000


def fading(number: int) -> Trace:
    """A link that is nearly gone for some seconds of every 24, each robot's at another time."""
    steps = 48
    depth = [max(0.0, math.cos(2 * math.pi * (k / steps - 0.35 - 0.31 * number))) ** 4 for k in range(steps)]
    rates = [CLEAR_BPS / 8 * (FADED_BPS / CLEAR_BPS) ** d for d in depth]
    return Trace.steps([(FADES_S / steps, rate) for rate in rates], name=f"fade-{number}")


@contextlib.asynccontextmanager
async def running(
    robots: int = 3,
    port: int = 0,
    *,
    policy: str | Policy = "robofleet",
    capacity: int = 16,
    folder: Path | None = None,
    fades: bool = True,
    say: Callable[[str], None] = lambda text: None,
) -> AsyncIterator[int]:
    """The port of a relay that this machine may use, and that ``robots`` made-up ones connect to.

    The relay and its page are there at once; the robots come when their queue is compiled, which the first time takes
    up to a minute. ``folder``: it records there.
    """
    rules = (Rule(address="127.0.0.1", send=True, receive=True), Rule(recorder=True, receive=True))
    server = Server(Config(port=port, rules=rules[: 1 if folder is None else 2], folder=folder))
    client = read_client(CONFIG)
    async with contextlib.AsyncExitStack() as stack:
        port = await server.start()
        stack.push_async_callback(server.close)

        def robot(number: int, to: int) -> Robot:
            return Robot(
                f"ws://127.0.0.1:{to}",
                f"robot-{number + 1}",
                MadeUp(number, client.streams),
                policy=policy,
                capacity=capacity,
                window=client.window,
                say=say,
            )

        async def run(number: int, to: int) -> None:
            await compiled
            await robot(number, to).run()

        compiled = asyncio.create_task(_compiled(policy, say))
        tasks = [compiled]
        for number in range(robots):
            to = port
            if fades:
                link = ShapedLink(Link(fading(number), propagation_us=DELAY_US), ("127.0.0.1", port))
                to = await link.listen()
                stack.push_async_callback(link.close)
            tasks.append(asyncio.create_task(run(number, to)))
        try:
            yield port
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


@contextlib.asynccontextmanager
async def uncompiled(words: Sequence[str]) -> AsyncIterator[None]:
    """``bufgym relay demo`` with these words in a process that compiles nothing, as long as the block takes.

    So three robots and their relay take three quarters of a core.
    """
    command = [sys.executable, "-m", "bufgym", "relay", "demo", *words]
    process = await asyncio.create_subprocess_exec(*command, env={**os.environ, "NUMBA_DISABLE_JIT": "1"})

    def end() -> None:
        with contextlib.suppress(ProcessLookupError):  # it has ended by itself
            process.terminate()

    def end_both() -> None:
        end()
        loop.remove_signal_handler(signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)

    loop = asyncio.get_running_loop()
    with contextlib.suppress(NotImplementedError):  # Windows
        loop.add_signal_handler(signal.SIGTERM, end_both)
    try:
        yield
    finally:
        with contextlib.suppress(NotImplementedError):
            loop.remove_signal_handler(signal.SIGTERM)
        end()
        await process.wait()


async def _compiled(policy: str | Policy, say: Callable[[str], None]) -> None:
    """Returns when a robot's queue is compiled; says that this is what takes the time, where it does."""
    compiling = asyncio.create_task(asyncio.to_thread(policies.compiled, registry.get(policy)))
    try:
        async with asyncio.timeout(PATIENCE_S):
            await asyncio.shield(compiling)
    except TimeoutError:
        say("the robots come when their queue is compiled: up to a minute, the first time")
        await compiling

"""A relay with made-up robots over fading links, all in one process: something to look at within seconds.

    python examples/fleet_demo.py --robots 3

Open the page that it names. The robots come when their queue is compiled, which the first time takes up to a minute.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import webbrowser
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Final

from made_up_robot import CONFIG, MadeUp

from bufgym.model import Link
from bufgym.policies import Policy, get
from bufgym.scenario import read_client
from bufgym.traces import Trace
from bufgym_relay import Config, Foxglove, Rule, Server, compiled
from bufgym_robot import Robot, ShapedLink

CLEAR_BPS: Final = 1_000_000
FADED_BPS: Final = 100_000
"""A robot wants 550 kbit/s."""
FADES_S: Final = 24.0
DELAY_US: Final = 20_000
EVERYTHING: Final = (Rule(address="127.0.0.1", send=True, receive=True), Rule(foxglove=True, receive=True))


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
    folder: Path | None = None,
    foxglove: int | None = None,
    fades: bool = True,
    say: Callable[[str], None] = lambda text: None,
) -> AsyncIterator[int]:
    """The port of a relay that this machine may use, and that ``robots`` made-up ones connect to.

    It records in ``folder``, and shows the robots to Foxglove and Lichtblick on the port ``foxglove``.
    """
    recorder = () if folder is None else (Rule(recorder=True, receive=True),)
    screen = None if foxglove is None else Foxglove(port=foxglove)
    server = Server(Config(port=port, rules=EVERYTHING + recorder, folder=folder, foxglove=screen))
    client, chosen = read_client(CONFIG), get(policy)
    async with contextlib.AsyncExitStack() as stack:
        port = await server.start()
        stack.push_async_callback(server.close)
        compiling = asyncio.create_task(asyncio.to_thread(compiled, chosen))

        async def run(number: int, to: int) -> None:
            await asyncio.shield(compiling)
            source = MadeUp(number, client.streams)
            url, name = f"ws://127.0.0.1:{to}", f"robot-{number + 1}"
            await Robot(url, name, source, policy=chosen, capacity=16, say=say).run()

        tasks = []
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
            await asyncio.gather(*tasks, compiling, return_exceptions=True)


async def show(robots: int, port: int, policy: str, folder: Path | None, foxglove: int | None, browser: bool) -> None:
    async with running(robots, port, policy=policy, folder=folder, foxglove=foxglove, say=print) as port:
        page = f"http://127.0.0.1:{port}/"
        print(f"{page}: {robots} robots; Ctrl-C ends it", flush=True)
        if browser:
            webbrowser.open(page)
        await asyncio.Event().wait()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=3, help="(%(default)s)")
    parser.add_argument("--port", type=int, default=7420, help="of the relay (%(default)s)")
    parser.add_argument("--policy", default="robofleet", help="of the robots (%(default)s)")
    parser.add_argument("--folder", type=Path, help="record there")
    parser.add_argument("--foxglove", type=int, metavar="PORT", help="show them in Foxglove and Lichtblick too")
    parser.add_argument("--no-browser", action="store_false", dest="browser", help="do not open the page")
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(show(**vars(parser.parse_args())))

"""A relay that restarts, and the story of restarts played at it."""

import contextlib
import sys
from collections import Counter
from collections.abc import AsyncIterator, Sequence

from cut_cases import cuttable
from relay_cases import wait
from restart_robots import Within
from restart_story import Field, Make
from restart_truth import DEADLINE_S

from bufgym_relay.config import Config, Rule
from bufgym_relay.server import Server

RULE = Rule(address="127.0.0.0/8", send=True, receive=True, command_s=DEADLINE_S)


class Relay:
    """A relay that can be started anew, on the same port and with the same folder."""

    def __init__(self, config: Config) -> None:
        self.config = config

    async def begin(self) -> None:
        self.server = Server(self.config)
        await wait("a relay's start", self.server.start())

    async def end(self) -> None:
        await wait("a relay's end", self.server.close())

    async def again(self) -> None:
        await self.end()
        await self.begin()


@contextlib.asynccontextmanager
async def begun(config: Config) -> AsyncIterator[Relay]:
    one = Relay(config)
    await one.begin()
    try:
        yield one
    finally:
        await one.end()


@contextlib.asynccontextmanager
async def played(robot: int, operators: int, seed: int, make: Make = Within) -> AsyncIterator[Field]:
    """Robot and operators at relays of these ports; in the end nothing that must not be has been."""
    async with contextlib.AsyncExitStack() as stack:
        links = [await stack.enter_async_context(cuttable(port)) for port in (robot, operators, operators)]
        async with Field(links, sorted({robot, operators}), seed, make) as one:
            yield one


async def play(one: Field, rounds: int, seed: int, first: Sequence[str] = ()) -> Counter[str]:
    """Play so many rounds; the first ones begin with these shakes."""
    try:
        for k in range(rounds):
            await one.round(*first[k : k + 1])
    finally:
        print(f"seed {seed}: {dict(one.truth.counts)} {one.truth.wrong}", file=sys.stderr, flush=True)
    counts = one.truth.counts
    assert counts["rounds"] == rounds and counts["goals"] and counts["stops"]
    assert counts["velocities"] or rounds < 10  # of two rounds on a busy machine each may have come too late
    return one.truth.counts

"""The same episodes on real sockets and in the simulator, side by side."""

import asyncio
import math
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bufgym import oracle
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy
from bufgym.scenario import Episode, Streams, Uplink
from bufgym.sim import run
from bufgym.sim.metrics import outcome, received
from bufgym.utils.errors import BufgymError
from bufgym_robot.channels import TRANSPORTS, Channel
from bufgym_robot.receiver import Received, Receiver
from bufgym_robot.runs import LiveRun
from bufgym_robot.sender import Leaves, Sender
from bufgym_robot.shaped import ShapedLink
from bufgym_robot.wire.log import Record
from bufgym_robot.wire.queue import PolicyQueue


async def play(
    policy: Policy,
    episode: Episode,
    capacity: int,
    value: Value,
    *,
    topics: Sequence[Topic] = (),
    transport: str = "tcp",
    leaves: Leaves = "sent",
    small: bool = True,
    speed: float = 1.0,
    seed: int = 0,
    log: list[Record] | None = None,
    port: int = 0,
    until_s: float = math.inf,
) -> list[Received]:
    """Send the messages of ``episode`` with ``policy`` over real sockets and its link; return the messages received.

    ``received_ns`` counts from the episode's beginning like ``at_us``, but in this system's time.

    Args:
        topics: rules of each topic; empty for one queue without rules.
        transport: one of ``TRANSPORTS`` over TCP.
        leaves: event at which a message has left, see ``Leaves``.
        small: whether the system's buffers are small instead of default.
        speed: speed-up of time for queue and link alike; bytes stay the same.
        seed: seed of randomised policies' draws.
        log: list to which the queue's records are appended.
        port: the receiver's port, 0 for any; over MQTT the broker's.
        until_s: episode time after which later messages are not awaited.
    """
    if transport not in TRANSPORTS:
        raise BufgymError(f"transport {transport!r}: must be one of {', '.join(TRANSPORTS)}")
    warm(PolicyQueue(policy, capacity, value=value, topics=topics, window=episode.window))
    came: list[Received] = []
    receiver = Receiver(partial(take, came))
    link = ShapedLink(episode.link, ("127.0.0.1", await receiver.listen(port, transport=transport)), speed=speed)
    port = await link.listen()

    async def begin() -> float:
        link.begin()
        return time.monotonic()

    settings: dict[str, Any] = {"topics": topics, "leaves": leaves, "seed": seed, "log": log}
    connect = partial(TRANSPORTS[transport], "127.0.0.1", port, small=small)
    try:
        began_s = await send(policy, episode, capacity, value, connect, begin, speed=speed, until_s=until_s, **settings)
    finally:
        await link.close()
        await receiver.close()
    return since(began_s, came)


async def send(
    policy: Policy,
    episode: Episode,
    capacity: int,
    value: Value,
    connect: Callable[[], Awaitable[Channel]],
    begin: Callable[[], Awaitable[float]],
    *,
    topics: Sequence[Topic] = (),
    leaves: Leaves = "sent",
    speed: float = 1.0,
    seed: int = 0,
    log: list[Record] | None = None,
    until_s: float = math.inf,
) -> float:
    """Send the messages of ``episode`` as they arrive; return its beginning by this system's monotonic clock, s.

    ``begin`` is awaited once there is a connection, and returns the beginning. Others as for ``play``.
    """
    messages = episode.arrivals
    bodies = memoryview(bytes(int(messages["size_bytes"].max())))
    began_s = time.monotonic()
    rules: dict[str, Any] = {"value": value, "topics": topics, "window": episode.window, "seed": seed}
    rules |= {"duration_s": None if episode.ends_us is None else episode.ends_us / 1e6}
    rules |= {"log": None if log is None else log.append, "clock": lambda: (time.monotonic() - began_s) * speed}
    queue = PolicyQueue(policy, capacity, **rules)
    sender = Sender(queue, connect, leaves)
    sending = asyncio.create_task(sender.run())
    try:
        await asyncio.wait_for(sender.connected.wait(), 30)
        began_s = await begin()
        for message in messages:
            wait_s = began_s + float(message["arrival_us"]) / 1e6 / speed - time.monotonic()
            await asyncio.sleep(max(0.0, wait_s))
            size_bytes = int(message["size_bytes"])
            queue.put(bodies[:size_bytes], size_bytes, float(message["x"]), int(message["topic"]))
        queue.close()
        rest_s = began_s + until_s / speed - time.monotonic()
        await asyncio.wait([sending], timeout=None if rest_s == math.inf else max(0.0, rest_s))
        if sending.done():
            sending.result()  # or its error
    finally:
        sending.cancel()
        await asyncio.gather(sending, return_exceptions=True)
    return began_s


def take(came: list[Received], message: Received) -> None:
    """Keep a message without its body, with its time of receipt by the monotonic clock."""
    came.append(message._replace(body=b"", received_ns=time.monotonic_ns()))


def since(began_s: float, came: Sequence[Received]) -> list[Received]:
    """The messages, with ``received_ns`` since the episode's beginning."""
    return [message._replace(received_ns=message.received_ns - round(began_s * 1e9)) for message in came]


def warm(queue: PolicyQueue) -> None:
    """Send one message through the queue, so that nothing is compiled while the episode runs."""
    queue.put(b"", 1)
    queue.get()
    queue.gone()
    queue.close()


Play = Callable[..., list[Received]]
"""Plays live: (policy, episode, capacity, value, speed=1.0, seed=0) -> the messages received, as ``play`` has them."""


def over(transport: str) -> Play:
    """Make a ``Play`` over one of ``TRANSPORTS``."""
    return lambda *episode, **settings: asyncio.run(play(*episode, transport=transport, **settings))


def validate(
    policies: Sequence[Policy],
    scenario: Uplink,
    capacity: int,
    *,
    seeds: int = 1,
    plays: Mapping[str, Play] | None = None,
    speed: float = 1.0,
) -> list[LiveRun]:
    """Run every policy on ``seeds`` episodes of every trace, simulated and live by each of ``plays``, by default
    TCP."""
    plays = {"tcp": over("tcp")} if plays is None else plays
    runs = []
    for trace in scenario.traces:
        for seed in range(seeds):
            episode = replace(scenario, traces=(trace,)).draw(Streams.seeded(seed))
            best = oracle.clairvoyant(episode, capacity, scenario.value).qoi
            for policy in policies:
                drawn = episode.with_uniforms(np.random.default_rng(seed))
                simulated = run(policy, [drawn], capacity, scenario.value)
                messages = received(simulated, 0)
                transmitted_us = simulated.batch.log["transmitted_us"][0, messages["seq"]]
                delivery_us = transmitted_us + episode.link.propagation_us - messages["arrival_us"]
                theirs = outcome(simulated, 0).qoi, best
                for transport, played in plays.items():
                    came = played(policy, episode, capacity, scenario.value, speed=speed, seed=seed)
                    live_s = tuple(message.received_ns / 1e9 * speed - message.at_us / 1e6 for message in came)
                    qoi = scenario.value.information([message.x for message in came]), *theirs
                    times_s = live_s, tuple((delivery_us / 1e6).tolist())
                    of = policy.name, trace.name, seed
                    runs.append(LiveRun(*of, len(came), len(messages), *qoi, transport, *times_s))
    return runs

"""The same episodes on real sockets and in the simulator, side by side."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from bufgym import oracle
from bufgym.errors import BufgymError
from bufgym.live.channels import TRANSPORTS
from bufgym.live.log import Record
from bufgym.live.queue import PolicyQueue
from bufgym.live.receiver import Received, Receiver
from bufgym.live.runs import Run
from bufgym.live.sender import Leaves, Sender
from bufgym.live.shaped import ShapedLink
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy
from bufgym.scenario import Episode, Streams, Uplink
from bufgym.sim import run
from bufgym.sim.metrics import outcome, received


async def play(
    policy: Policy,
    episode: Episode,
    capacity: int,
    value: Value,
    *,
    topics: Sequence[Topic] = (),
    transport: str = "tcp",
    leaves: Leaves = "acked",
    small: bool = True,
    speed: float = 1.0,
    seed: int = 0,
    log: list[Record] | None = None,
    port: int = 0,
    until_s: float = math.inf,
) -> list[Received]:
    """What arrives at the other end of real sockets, when ``policy`` sends the messages of ``episode`` over its link.

    ``received_ns`` counts from the episode's beginning, as ``at_us`` does, but as this system's time runs.

    Args:
        topics: the rules for each; none for one queue without rules.
        transport: one of ``TRANSPORTS`` over TCP.
        leaves: when a message has left, see ``Sender``.
        small: small buffers in the system; else its default ones.
        speed: how much faster time runs for queue and link alike; bytes are as they are.
        seed: of the draws of randomised policies.
        log: takes the queue's records.
        port: the receiver's (0: any); over MQTT the broker's.
        until_s: after the last message, what arrives later is not waited for; in the episode's time.
    """
    if transport not in TRANSPORTS:
        raise BufgymError(f"transport {transport!r}: must be one of {', '.join(TRANSPORTS)}")
    warm(PolicyQueue(policy, capacity, value=value, topics=topics, window=episode.window))
    came: list[Received] = []

    def take(message: Received) -> None:
        came.append(message._replace(body=b"", received_ns=time.monotonic_ns() - round(began_s * 1e9)))

    receiver = Receiver(take)
    link = ShapedLink(episode.link, ("127.0.0.1", await receiver.listen(port, transport=transport)), speed=speed)
    port = await link.listen()
    messages = episode.arrivals
    bodies = memoryview(bytes(int(messages["size_bytes"].max())))
    began_s = time.monotonic()
    queue = PolicyQueue(
        policy,
        capacity,
        value=value,
        topics=topics,
        window=episode.window,
        seed=seed,
        log=None if log is None else log.append,
        clock=lambda: (time.monotonic() - began_s) * speed,
    )
    sender = Sender(queue, lambda: TRANSPORTS[transport]("127.0.0.1", port, small=small), leaves)
    sending = asyncio.create_task(sender.run())
    try:
        await asyncio.wait_for(sender.connected.wait(), 30)
        began_s = time.monotonic()
        link.begin()
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
        await link.close()
        await receiver.close()
    return came


def warm(queue: PolicyQueue) -> None:
    """One message through the queue, so that nothing is compiled while the episode's time runs."""
    queue.put(b"", 1)
    queue.get()
    queue.gone()
    queue.close()


class Play(Protocol):
    """How an episode is played live; what comes, as ``play`` has it."""

    def __call__(
        self, policy: Policy, episode: Episode, capacity: int, value: Value, *, speed: float = 1.0, seed: int = 0
    ) -> list[Received]: ...


def over(transport: str) -> Play:
    """``play`` over one of ``TRANSPORTS``."""

    def played(
        policy: Policy, episode: Episode, capacity: int, value: Value, *, speed: float = 1.0, seed: int = 0
    ) -> list[Received]:
        return asyncio.run(play(policy, episode, capacity, value, transport=transport, speed=speed, seed=seed))

    return played


def validate(
    policies: Sequence[Policy],
    scenario: Uplink,
    capacity: int,
    *,
    seeds: int = 1,
    plays: Mapping[str, Play] | None = None,
    speed: float = 1.0,
) -> list[Run]:
    """Every policy on ``seeds`` episodes of every trace: live by ``plays`` in turn (default: TCP), and simulated."""
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
                for transport, played in plays.items():
                    came = played(policy, episode, capacity, scenario.value, speed=speed, seed=seed)
                    runs.append(
                        Run(
                            policy.name,
                            trace.name,
                            seed,
                            len(came),
                            len(messages),
                            scenario.value.information([message.x for message in came]),
                            outcome(simulated, 0).qoi,
                            best,
                            transport,
                            tuple(message.received_ns / 1e9 * speed - message.at_us / 1e6 for message in came),
                            tuple((delivery_us / 1e6).tolist()),
                        )
                    )
    return runs

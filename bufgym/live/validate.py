"""The same episodes on real sockets and in the simulator, side by side."""

from __future__ import annotations

import asyncio
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bufgym import oracle
from bufgym.errors import BufgymError
from bufgym.live.channels import TRANSPORTS
from bufgym.live.log import Record
from bufgym.live.queue import PolicyQueue
from bufgym.live.receiver import Received, Receiver
from bufgym.live.sender import Leaves, Sender
from bufgym.live.shaped import ShapedLink
from bufgym.model.qoi import Value
from bufgym.oracle.measure import regret
from bufgym.policies.registry import Policy
from bufgym.scenario import Episode, Streams, Uplink
from bufgym.sim import run
from bufgym.sim.metrics import outcome, received


@dataclass(frozen=True)
class Run:
    """One policy on one episode, live and simulated."""

    policy: str
    link: str
    seed: int
    live_delivered: int
    simulated_delivered: int
    live_qoi: float
    simulated_qoi: float
    best_qoi: float
    """The clairvoyant's H."""

    @property
    def live_regret(self) -> float:
        return regret(self.live_qoi, self.best_qoi)

    @property
    def simulated_regret(self) -> float:
        return regret(self.simulated_qoi, self.best_qoi)

    @property
    def qoi_difference(self) -> float:
        """Live over simulated H, less 1."""
        return self.live_qoi / self.simulated_qoi - 1 if self.simulated_qoi else 0.0


async def play(
    policy: Policy,
    episode: Episode,
    capacity: int,
    value: Value,
    *,
    transport: str = "tcp",
    leaves: Leaves = "acked",
    small: bool = True,
    speed: float = 1.0,
    seed: int = 0,
    log: list[Record] | None = None,
) -> list[Received]:
    """What arrives at the other end of real sockets, when ``policy`` sends the messages of ``episode`` over its link.

    Args:
        transport: "tcp" or "websocket".
        leaves: when a message has left, see ``Sender``.
        small: small buffers in the system; else its default ones.
        speed: how much faster time runs for queue and link alike; bytes are as they are.
        seed: of the draws of randomised policies.
        log: takes the queue's records.
    """
    if transport not in TRANSPORTS:
        raise BufgymError(f"transport {transport!r}: must be one of {', '.join(TRANSPORTS)}")
    came: list[Received] = []

    def take(message: Received) -> None:
        came.append(message._replace(body=b""))

    receiver = Receiver(take)
    link = ShapedLink(episode.link, ("127.0.0.1", await receiver.listen(transport=transport)), speed=speed)
    port = await link.listen()
    messages = episode.arrivals
    bodies = memoryview(bytes(int(messages["size_bytes"].max())))
    began_s = time.monotonic()
    queue = PolicyQueue(
        policy,
        capacity,
        value=value,
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
            queue.put(bodies[:size_bytes], size_bytes, float(message["x"]))
        queue.close()
        await sending
    finally:
        sending.cancel()
        await asyncio.gather(sending, return_exceptions=True)
        await link.close()
        await receiver.close()
    return came


def validate(
    policies: Sequence[Policy],
    scenario: Uplink,
    capacity: int,
    *,
    seeds: int = 1,
    transport: str = "tcp",
    speed: float = 1.0,
) -> list[Run]:
    """Every policy on ``seeds`` episodes of every trace, on sockets one after the other, and in the simulator."""
    runs = []
    for trace in scenario.traces:
        for seed in range(seeds):
            episode = replace(scenario, traces=(trace,)).draw(Streams.seeded(seed))
            best = oracle.clairvoyant(episode, capacity, scenario.value).qoi
            for policy in policies:
                drawn = episode.with_uniforms(np.random.default_rng(seed))
                simulated = run(policy, [drawn], capacity, scenario.value)
                came = asyncio.run(
                    play(policy, episode, capacity, scenario.value, transport=transport, speed=speed, seed=seed)
                )
                runs.append(
                    Run(
                        policy.name,
                        trace.name,
                        seed,
                        len(came),
                        len(received(simulated, 0)),
                        scenario.value.information([message.x for message in came]),
                        outcome(simulated, 0).qoi,
                        best,
                    )
                )
    return runs


def table(runs: Sequence[Run]) -> str:
    """The runs in Markdown: means by policy, then how far apart live and simulated are."""
    lines = [
        "| policy | delivered, live | simulated | QoI, live | simulated | regret, live | simulated |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    by_policy: dict[str, list[Run]] = {}
    for one in runs:
        by_policy.setdefault(one.policy, []).append(one)

    def mean(name: str, chosen: list[Run]) -> Any:
        return statistics.fmean(getattr(one, name) for one in chosen)

    for name, chosen in sorted(by_policy.items(), key=lambda entry: -mean("simulated_qoi", entry[1])):
        cells = [
            f"{mean('live_delivered', chosen):.1f}",
            f"{mean('simulated_delivered', chosen):.1f}",
            f"{mean('live_qoi', chosen):.3f}",
            f"{mean('simulated_qoi', chosen):.3f}",
            f"{mean('live_regret', chosen):.2%}",
            f"{mean('simulated_regret', chosen):.2%}",
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    apart = [abs(one.qoi_difference) for one in runs]
    counts = [abs(one.live_delivered - one.simulated_delivered) for one in runs]
    lines.append(
        f"\n{len(runs)} runs: QoI live and simulated {statistics.median(apart):.2%} apart (median), "
        f"{max(apart):.2%} at most; delivered {statistics.median(counts):g} and {max(counts)}."
    )
    return "\n".join(lines)

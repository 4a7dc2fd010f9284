"""Episodes between two network namespaces with a round trip between them: ``validate.play``, with TCP's own delay.

Sender, link and receiver are programs of their own. The link's propagation delay is half the round trip.
"""

import asyncio
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from bufgym.model.qoi import Value
from bufgym.policies.registry import Policy
from bufgym.scenario import Episode
from bufgym_robot import PolicyQueue, programs
from bufgym_robot.channels import TRANSPORTS
from bufgym_robot.receiver import Received, Receiver
from bufgym_robot.tunnel import Tunnel
from bufgym_robot.validate import Play, send, since, take, warm


def over(tunnel: Tunnel, transport: str, port: int = 0) -> Play:
    """Make a ``Play`` over one of ``TRANSPORTS`` through the tunnel; ``port`` is the receiver's, 0 for any."""
    return partial(play, tunnel, transport, port)


def play(
    tunnel: Tunnel,
    transport: str,
    port: int,
    policy: Policy,
    episode: Episode,
    capacity: int,
    value: Value,
    *,
    small: bool = True,
    speed: float = 1.0,
    **settings: Any,
) -> list[Received]:
    """Play the episode; return the messages received. ``small`` and ``settings`` as for ``validate.play``."""
    programs.check_speed(speed)
    warm(PolicyQueue(policy, capacity, value=value, window=episode.window))
    with programs.running(
        link=partial(tunnel.carry, episode.link),
        receiver=partial(_receive, tunnel, transport, port),
        sender=partial(_send, tunnel, transport, small, partial(send, policy, episode, capacity, value, **settings)),
    ) as workers:
        return asyncio.run(_play(workers))


async def _play(workers: Sequence[programs.Worker]) -> list[Received]:
    link, receiver, sender = workers
    sender.send(await receiver.receive())
    await sender.receive()  # of a connection
    began_s = time.monotonic() + programs.START_S
    link.send(began_s)
    sender.send(began_s)
    await sender.receive(patience_s=math.inf)  # of the last ack
    receiver.send("all is sent")
    return since(began_s, await receiver.receive())


def _receive(tunnel: Tunnel, transport: str, port: int, parent: Connection) -> None:
    tunnel.far.enter()
    came: list[Received] = []

    async def receive() -> None:
        receiver = Receiver(partial(take, came))
        parent.send(await receiver.listen(port, tunnel.far.address, transport))
        await asyncio.to_thread(parent.recv)
        await receiver.close()

    asyncio.run(receive())
    parent.send(came)
    parent.recv()


def _send(tunnel: Tunnel, transport: str, small: bool, sending: Callable[..., Any], parent: Connection) -> None:
    tunnel.near.enter()
    connect = partial(TRANSPORTS[transport], tunnel.far.address, parent.recv(), small=small)

    async def begin() -> float:
        parent.send("connected")
        began_s: float = await asyncio.to_thread(parent.recv)
        await asyncio.sleep(began_s - time.monotonic())
        return began_s

    asyncio.run(sending(connect, begin))
    parent.send("all is acked")
    parent.recv()

"""A stop on a path that carries nothing to the robot for a while: it is there a second after the path is back."""

import asyncio
import threading
import time
from typing import Any

from relay_cases import settings
from test_stops import Program
from wire_cases import FAR, PORT, Wire, at, between, waited  # noqa: F401  (a fixture)

from bufgym_relay.config import Rule
from bufgym_relay.server import Server
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.tunnel import Tunnel
from bufgym_robot.wire.session import Session

ANYBODY = Rule(address="0.0.0.0/0", send=True, receive=True)
DEAD_S = 8.0
SOON_S = 4.0
"""The bound is 1 s, on a machine that has time. TCP's own backoff would take 5 to 6 s."""


def test_a_stop_comes_a_second_after_a_dead_downlink(between: tuple[Tunnel, Wire]) -> None:  # noqa: F811
    made, wire = between
    program, ready, over = Program(), threading.Event(), threading.Event()
    stopped = dict[str, Any]()

    async def serve() -> None:
        server = Server(settings(host=FAR, port=PORT, rules=(ANYBODY,)))
        await server.start()
        operator = Session(f"ws://{FAR}:{PORT}", "operator")
        running = asyncio.create_task(operator.run())
        await operator.ready.wait()
        ready.set()
        await asyncio.to_thread(over.wait)
        await operator.stop("r")
        stopped["said"] = time.monotonic()
        await asyncio.sleep(60)
        running.cancel()

    at(made.far, lambda: asyncio.run(serve()))
    assert ready.wait(30)
    robot = Robot(f"ws://{FAR}:{PORT}", "r", program, policy="drop-oldest")
    at(made.near, lambda: asyncio.run(robot.run()))
    waited(lambda: robot.client.ready.is_set())
    wire.mute = made.far.device
    over.set()
    waited(lambda: "said" in stopped)
    time.sleep(DEAD_S)
    assert program.names == []
    wire.mute = None
    back_s = time.monotonic()
    waited(lambda: program.names == ["stop"])
    took_s = program.done[0][1] - back_s
    print(f"{took_s:.2f} s after {DEAD_S:g} s without a downlink")
    assert took_s < SOON_S

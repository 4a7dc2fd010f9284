"""``bufgym live``: the policies on real sockets."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import (
    Commands,
    command,
    count,
    given,
    least_0,
    load_policies,
    loaded,
    natural,
    policies_option,
    policy_file,
    positive,
)
from bufgym.ground.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.robot.validate import Play

PORT = 7410
"""Default port of a receiver."""
TRANSPORTS = ("tcp", "websocket", "zenoh", "mqtt")
VALIDATED = (*TRANSPORTS[:3], "ros1", "ros2")
"""Transports that can go through a shaped link."""
DEFAULT_POLICIES = ("drop-oldest", "afr", "min-motion-gap", "learned-motion")


def add(commands: Commands) -> None:
    live = commands.add_parser("live", help="policies on real sockets, beside the simulator")
    parts = live.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_ends(parts)
    link = command(
        parts, "link", _link, "a link of a trace's capacity between real sockets (a TCP proxy, without root)"
    )
    link.add_argument("--trace", required=True, metavar="FILE", help="bandwidth trace, a file or a shipped name")
    link.add_argument("--to", required=True, metavar="HOST:PORT", help="where it leads")
    link.add_argument("--port", type=natural, default=PORT + 1, help="where it begins (%(default)s)")
    link.add_argument("--scale", type=positive, default=1.0, metavar="X", help="the trace's capacity times X")
    link.add_argument("--delay-ms", type=least_0, default=0.0, metavar="MS", help="each way (%(default)g)")
    link.add_argument("--back", action="store_true", help="the messages come back from there (a publisher of ROS 1)")

    validate = command(parts, "validate", _validate, "the same episodes on real sockets and in the simulator")
    validate.add_argument("--trace", required=True, nargs="+", metavar="FILE", help="bandwidth traces, as in link")
    policies_option(validate, ", ".join(DEFAULT_POLICIES))
    policy_file(validate)
    validate.add_argument("--capacity", type=count, default=8, metavar="L", help="L, messages (%(default)s)")
    validate.add_argument("--seeds", type=count, default=1, help="episodes on each trace (%(default)s)")
    validate.add_argument("--duration", type=positive, default=30.0, metavar="S", help="of each (%(default)g s)")
    validate.add_argument("--size", type=count, default=230_000, metavar="BYTES", help="of a message (%(default)s)")
    validate.add_argument("--scale", type=positive, default=1.0, metavar="X", help="the traces' capacity times X")
    validate.add_argument("--transport", choices=VALIDATED, nargs="+", default=["tcp"], help="one or more (tcp)")
    validate.add_argument("--speed", type=positive, default=1.0, metavar="X", help="time runs X times as fast")
    validate.add_argument("--out", metavar="DIR", help="write every run there (JSON)")

    view = command(parts, "view", _view, "what a queue does, from its log: queue, drops, rates, QoI")
    view.add_argument("log", metavar="LOG.mcap", help="log of send --log, even a growing one")
    view.add_argument("--follow", action="store_true", help="show it again as the log grows; Ctrl-C ends it")

    replay = command(parts, "replay", _replay, "a queue's log through the simulator: the same decisions?")
    replay.add_argument("log", metavar="LOG.mcap", help="log of send --log")
    policy_file(replay)


def _add_ends(parts: Commands) -> None:
    send = command(parts, "send", _send, "made-up frames along a shipped motion, to a receiver")
    send.add_argument("to", nargs="?", default=f"127.0.0.1:{PORT}", metavar="HOST:PORT", help="(%(default)s)")
    send.add_argument("--policies", default="afr", metavar="NAME", help="the policy, as in bench (%(default)s)")
    policy_file(send)
    send.add_argument("--capacity", type=count, default=8, metavar="L", help="L, messages (%(default)s)")
    send.add_argument("--rate", type=positive, default=30.0, metavar="HZ", help="frames a second (%(default)g)")
    send.add_argument("--size", type=count, default=230_000, metavar="BYTES", help="of a frame (%(default)s)")
    send.add_argument("--duration", type=positive, default=30.0, metavar="S", help="(%(default)g s)")
    send.add_argument("--motion", default="drive-0", metavar="FILE", help="gives x (%(default)s); or 'none'")
    send.add_argument("--transport", choices=TRANSPORTS, default="tcp", help="(%(default)s)")
    send.add_argument("--log", metavar="LOG.mcap", help="log every decision there, for replay")
    send.add_argument("--view", action="store_true", help="show queue, drops, rates and QoI as it happens")

    receive = command(parts, "receive", _receive, "receive, ack and count what is sent here; Ctrl-C ends it")
    receive.add_argument("--port", type=natural, default=PORT, help="(%(default)s)")
    receive.add_argument("--host", default="127.0.0.1", help="address to listen on (%(default)s: this machine alone)")
    receive.add_argument("--transport", choices=TRANSPORTS, default="tcp", help="(%(default)s)")
    receive.add_argument("--out", metavar="FILE.mcap", help="write received messages to this file")
    receive.add_argument("--messages", type=count, help="stop after so many")


def address(text: str) -> tuple[str, int]:
    """Split ``HOST:PORT``."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or int(port) > 65_535:
        raise BufgymError(f"{text}: must be HOST:PORT")
    return host, int(port)


def run_async(work: Coroutine[Any, Any, None]) -> None:
    """Run until the end or Ctrl-C."""
    import asyncio

    asyncio.run(work)


def _link(options: argparse.Namespace) -> None:
    import asyncio

    from bufgym import traces
    from bufgym.model.link import Link
    from bufgym.robot.shaped import ShapedLink

    trace, target = traces.load(options.trace).scaled(options.scale), address(options.to)

    async def forward() -> None:
        link = ShapedLink(Link(trace, propagation_us=round(options.delay_ms * 1000)), target, back=options.back)
        port = await link.listen(options.port)
        link.begin()
        print(f"127.0.0.1:{port} -> {options.to} over {trace.name}; Ctrl-C ends it", flush=True)
        await asyncio.Event().wait()

    run_async(forward())


def _validate(options: argparse.Namespace) -> None:
    from bufgym import policies, traces
    from bufgym.robot.margins import margins
    from bufgym.robot.runs import save, table
    from bufgym.robot.validate import validate
    from bufgym.scenario import Uplink

    load_policies(options.policy_file)
    chosen = [policies.get(spec) for spec in loaded(options.policies)[0] or DEFAULT_POLICIES]
    scenario = Uplink(
        traces=tuple(traces.load(name) for name in options.trace),
        motion=tuple(traces.load_motion(name) for name in traces.shipped() if name.startswith("drive-")),
        size_bytes=options.size,
        duration_s=options.duration,
        scale=(options.scale,),
        propagation_us=0,
    )
    plays = {name: _play_over(name) for name in options.transport}
    about = (
        f"{options.duration:g} s, {options.size} bytes at 30 Hz, L = {options.capacity}, V = {scenario.value.name}, "
        f"over {', '.join(options.transport)} (one message at a time) and in the simulator"
    )
    print(f"{about}\n")
    runs = validate(
        chosen,
        scenario,
        options.capacity,
        seeds=options.seeds,
        plays=plays,
        speed=options.speed,
    )
    print("\n".join([table(runs), "", *map(str, margins(runs))]))
    if options.out is not None:
        print(f"\nwrote {save(runs, about, _command(options), Path(options.out))}")


def _play_over(transport: str) -> Play:
    """Find the player for a transport; raise an error if it is not installed."""
    if transport == "ros1":
        from bufgym.robot.ros1 import episode as ros1

        return ros1.player()
    if transport == "ros2":
        from bufgym.robot.ros2 import episode as ros2

        return ros2.player()
    from bufgym.robot.validate import over

    return over(transport)


def _command(options: argparse.Namespace) -> str:
    """Write the command that repeats this validation."""
    names = ("trace", "policies", "policy_file", "capacity", "seeds", "duration", "size", "scale", "transport", "speed")
    words = ["bufgym live validate"]
    for name, value in given(options, names).items():
        words.append(f"--{name.replace('_', '-')}")
        words += [shlex.quote(str(one)) for one in (value if isinstance(value, list) else [value])]
    return " ".join(words)


def _replay(options: argparse.Namespace) -> None:
    from bufgym.robot import replay

    load_policies(options.policy_file)
    played = replay(options.log)
    stats = played.outcome
    print(
        f"{stats.arrived} put, {stats.delivered} delivered, {stats.dropped} dropped, {stats.in_transmission} in "
        f"transmission, {stats.buffered} queued; QoI {stats.qoi:.3f}, longest gap {stats.longest_gap:g}"
    )
    if played.differences:
        first = "; ".join(played.differences[:3])
        raise BufgymError(f"{options.log}: the simulator decides otherwise {len(played.differences)} times: {first}")
    print("The simulator makes the same decisions.")


REDRAW_S = 0.25
"""Time between two drawings of a view."""


def _redraw(text: str) -> None:
    """Redraw in place on a terminal; append to a file."""
    print(f"\x1b[H\x1b[J{text}" if sys.stdout.isatty() else f"{text}\n", flush=True)


def _view(options: argparse.Namespace) -> None:
    import time

    from bufgym.robot import read_log
    from bufgym.robot.view import View

    size_bytes = -1
    while options.follow or size_bytes < 0:
        seen_bytes, size_bytes = size_bytes, Path(options.log).stat().st_size if Path(options.log).exists() else 0
        if size_bytes != seen_bytes:
            _redraw(View(read_log(options.log)).text())
        if options.follow:
            time.sleep(REDRAW_S)


def _send(options: argparse.Namespace) -> None:
    import asyncio
    import contextlib
    import math

    from bufgym import policies, traces
    from bufgym.model import qoi
    from bufgym.robot import LogFile, PolicyQueue
    from bufgym.robot.channels import TRANSPORTS as CONNECT
    from bufgym.robot.log import Record
    from bufgym.robot.sender import Sender
    from bufgym.robot.view import View

    load_policies(options.policy_file)
    (name,) = loaded([options.policies])[0]
    host, port = address(options.to)
    motion = None if options.motion == "none" else traces.load_motion(options.motion)

    async def stream(queue: PolicyQueue) -> None:
        loop, sender = asyncio.get_running_loop(), Sender(queue, lambda: CONNECT[options.transport](host, port))
        sending, began_s, body = asyncio.create_task(sender.run()), loop.time(), bytes(options.size)
        for k in range(round(options.rate * options.duration)):
            await asyncio.sleep(began_s + k / options.rate - loop.time())
            if sending.done():
                break
            x = None if motion is None else float(motion.at(round(k / options.rate * 1e6)))
            queue.put(body, len(body), x)
            if view is not None:
                if k % max(1, round(options.rate * REDRAW_S)) == 0:
                    _redraw(view.text())
            elif k % round(max(1.0, options.rate)) == 0:
                print(
                    f"{k / options.rate:4.0f} s: {k + 1} put, {queue.dropped} dropped, {len(queue)} queued", flush=True
                )
        queue.close()
        await sending
        if view is not None:
            _redraw(view.text())
        print(f"all put, {queue.dropped} dropped, {len(sender.faults)} broken connections {list(sender.faults)[-1:]}")

    with contextlib.ExitStack() as stack:
        log = None if options.log is None else stack.enter_context(LogFile(options.log))
        view = View() if options.view else None
        takers = [taker for taker in (log, view) if taker is not None]

        def record(one: Record) -> None:
            for taker in takers:
                taker(one)

        run_async(
            stream(PolicyQueue(policies.get(name), options.capacity, value=qoi.exponential(math.exp(-1)), log=record))
        )


def _receive(options: argparse.Namespace) -> None:
    import asyncio
    import contextlib

    from bufgym.robot.receiver import Received, Receiver, Recording

    async def take(record: Any) -> None:
        enough = asyncio.Event()
        taken = 0

        def on_message(message: Received) -> None:
            nonlocal taken
            record(message)
            taken += 1
            if taken % 30 == 1:
                print(f"{taken} received, the last: {message.seq}, {len(message.body)} bytes", flush=True)
            if taken == options.messages:
                enough.set()

        receiver = Receiver(on_message)
        port = await receiver.listen(options.port, options.host, options.transport)
        print(f"listening on {options.host}:{port}", flush=True)
        try:
            await enough.wait()
            await asyncio.sleep(0.1)  # for the last ack
        finally:
            await receiver.close()
            print(f"{taken} received; {len(receiver.faults)} broken connections {list(receiver.faults)[-1:]}")

    with contextlib.ExitStack() as stack:
        run_async(take(stack.enter_context(Recording(options.out)) if options.out else lambda message: None))

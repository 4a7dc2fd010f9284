"""``bufgym live send``, ``receive`` and ``link``: the two ends of a real link, and the link."""

import asyncio
import contextlib
import sys
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from bufgym.cli.options import Count, Least0, PolicyFile, PortNumber, Positive, checked, one_policy
from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.sockets import BACKOFF_S, LEAST_BACKOFF_S, MOST_BACKOFF_S, host_port

if TYPE_CHECKING:
    from bufgym_robot.sender import Sender

PORT = 7410  # Default port of a receiver
RECEIVER = f"127.0.0.1:{PORT}"

Transport = Annotated[Literal["tcp", "websocket", "zenoh", "mqtt"], Parameter(help="What carries messages.")]
Port = Annotated[PortNumber, Parameter(help="Where to listen.")]
Host = Annotated[str, Parameter(help="Address to listen on; by default this machine alone reaches it.")]
Window = Annotated[
    Count | None, Parameter(help="Messages sent and not yet acked, at most (default: as many as fill the link).")
]

Backoff = Annotated[
    float,
    checked(
        float,
        lambda number: LEAST_BACKOFF_S <= number <= MOST_BACKOFF_S,
        f"{LEAST_BACKOFF_S:g} to {MOST_BACKOFF_S:g}, in s",
    ),
    Parameter(help="Longest time between two tries of TCP at a dead link, s (Linux from 6.15 on)."),
]

REDRAW_S = 0.25  # Time between two drawings of a view


def address(text: str) -> tuple[str, int]:
    """Split ``HOST:PORT``; an address of IPv6 may stand in brackets."""
    host, _, port = text.rpartition(":")
    if host.startswith("[") and host.endswith("]") and ":" in host:
        host = host[1:-1]
    if not host or set(host) & set("[]") or not (port.isascii() and port.isdigit()) or int(port) > 65_535:
        raise BufgymError(f"{text}: must be HOST:PORT, as 192.168.1.5:7410, base:7410 or [fe80::1]:7410")
    return host, int(port)


def say(text: str) -> None:
    print(text, flush=True)


def redraw(text: str) -> None:
    """Redraw in place on a terminal; append to a file."""
    say(f"\x1b[H\x1b[J{text}" if sys.stdout.isatty() else f"{text}\n")


async def send(
    to: str = RECEIVER,
    /,
    *,
    policies: str = "afr",
    policy_file: PolicyFile = None,
    capacity: Count = 8,
    rate: Positive = 30.0,
    size: Count = 230_000,
    duration: Positive = 30.0,
    motion: str = "drive-0",
    transport: Transport = "tcp",
    window: Window = None,
    backoff: Backoff = BACKOFF_S,
    log: str | None = None,
    view: bool = False,
) -> None:
    """Send made-up frames along a shipped motion to a receiver.

    Args:
        to: HOST:PORT of the receiver.
        policies: The policy, as in bench.
        capacity: L, messages.
        rate: Frames a second.
        size: Of a frame, bytes.
        duration: Seconds; the policy knows it.
        motion: File or shipped name that gives x; or 'none'.
        log: Log every decision to this file (.mcap), for replay.
        view: Show queue, drops, rates and QoI as it happens.
    """
    import math

    from bufgym import traces
    from bufgym.model import qoi
    from bufgym_robot import LogFile, PolicyQueue
    from bufgym_robot.channels import TRANSPORTS
    from bufgym_robot.sender import Leaves, Sender
    from bufgym_robot.view import View
    from bufgym_robot.wire.log import Record

    policy, (host, port) = one_policy(policies, policy_file), address(to)
    path = None if motion == "none" else traces.load_motion(motion)
    with contextlib.ExitStack() as stack:
        file = None if log is None else stack.enter_context(LogFile(log))
        shown = View() if view else None

        def record(one: Record) -> None:
            for taker in (file, shown):
                if taker is not None:
                    taker(one)

        answered = False

        def tell(fault: str) -> None:
            nonlocal answered
            answered |= not fault
            if fault and answered and not view:
                say(f"{to}: {fault}")

        value = qoi.exponential(math.exp(-1))
        queue = PolicyQueue(policy, capacity, value=value, duration_s=duration, log=record, window=window or 1)
        leaves: Leaves = "sent" if window is None else "acked"
        loop = asyncio.get_running_loop()
        sender = Sender(queue, lambda: TRANSPORTS[transport](host, port, backoff_s=backoff), leaves, tell)
        sending, began_s, body = asyncio.create_task(sender.run()), loop.time(), bytes(size)
        for k in range(round(rate * duration)):
            await asyncio.sleep(began_s + k / rate - loop.time())
            if sending.done():
                break
            queue.put(body, size, None if path is None else float(path.at(round(k / rate * 1e6))))
            if shown is not None:
                if k % max(1, round(rate * REDRAW_S)) == 0:
                    redraw(shown.text())
            elif k % round(max(1.0, rate)) == 0:
                alone = _alone(sender, to, k > 0)
                say(f"{k / rate:4.0f} s: {k + 1} put, {queue.dropped} dropped, {len(queue)} queued{alone}")
        queue.close()
        if alone := _alone(sender, to):
            say(f"{len(queue) + queue.in_flight} messages wait for the receiver, Ctrl-C drops them{alone}")
        await sending
        if shown is not None:
            redraw(shown.text())
        say(f"all put, {queue.dropped} dropped, {len(sender.faults)} broken connections {list(sender.faults)[-1:]}")


def _alone(sender: "Sender", to: str, asked_long: bool = True) -> str:
    """Why nothing goes, where no receiver has answered; empty while it is still being asked for the first time."""
    if sender.connected.is_set() or not (asked_long or sender.faults):
        return ""
    return f"; nobody answers at {to}" + (f" ({sender.faults[-1]})" if sender.faults else "")


def listens_at(at: str | None, host: str, port: int) -> tuple[str, int]:
    """Address to listen on: ``HOST:PORT`` if it is given, otherwise the options."""
    return (host, port) if at is None else address(at)


async def receive(
    at: str | None = None,
    /,
    *,
    port: Port = PORT,
    host: Host = "127.0.0.1",
    transport: Transport = "tcp",
    out: str | None = None,
    messages: Count | None = None,
) -> None:
    """Receive, ack and count the messages sent here; Ctrl-C ends it.

    Args:
        at: HOST:PORT to listen on, in place of --host and --port.
        out: Write received messages to this file (.mcap).
        messages: Stop after so many.
    """
    from bufgym_robot.receiver import Received, Receiver, Recording
    from bufgym_robot.wire.mcap_file import MAX_CHANNELS

    host, port = listens_at(at, host, port)
    enough, taken = asyncio.Event(), 0

    def take(message: Received) -> None:
        nonlocal taken
        if recording is not None:
            recording(message)
        taken += 1
        if taken % 30 == 1:
            say(f"{taken} received, the last: {message.seq}, {len(message.body)} bytes")
        if taken == messages:
            enough.set()

    with contextlib.ExitStack() as stack:
        recording: Any = None if out is None else stack.enter_context(Recording(out))
        receiver = Receiver(take)
        say(f"listening on {host_port(host, await receiver.listen(port, host, transport))}")
        try:
            await enough.wait()
            await asyncio.sleep(0.1)  # for the last ack
        finally:
            await receiver.close()
            if recording is not None and recording.left_out:
                say(f"{out}: {recording.left_out} messages left out: must be of at most {MAX_CHANNELS} topics")
            say(f"{taken} received; {len(receiver.faults)} broken connections {list(receiver.faults)[-1:]}")


async def link(
    *, trace: str, to: str, port: Port = PORT + 1, scale: Positive = 1.0, delay_ms: Least0 = 0.0, back: bool = False
) -> None:
    """Put a link of a trace's capacity between real sockets (a TCP proxy, without root).

    Args:
        trace: Bandwidth trace, a file or a shipped name.
        to: HOST:PORT where it leads.
        scale: The trace's capacity times this.
        delay_ms: Each way.
        back: The messages come back from there (a publisher of ROS 1).
    """
    from bufgym import traces
    from bufgym.model.link import Link
    from bufgym_robot.shaped import ShapedLink

    bandwidth = traces.load(trace).scaled(scale)
    shaped = ShapedLink(Link(bandwidth, propagation_us=round(delay_ms * 1000)), address(to), back=back)
    begin = await shaped.listen(port)
    shaped.begin()
    say(f"127.0.0.1:{begin} -> {to} over {bandwidth.name}; Ctrl-C ends it")
    await asyncio.Event().wait()

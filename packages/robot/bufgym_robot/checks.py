"""``bufgym live validate``, ``view`` and ``replay``: a queue on real sockets beside the simulator."""

from __future__ import annotations

import contextlib
import importlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bufgym.cli.options import Count, Least0, PolicyFile, Positive, command_line, load_policies, policies_of
from bufgym.utils.errors import BufgymError
from bufgym_robot.commands import REDRAW_S, redraw

if TYPE_CHECKING:
    from bufgym_robot.tunnel import Tunnel
    from bufgym_robot.validate import Play


def validate(
    *,
    trace: list[str],
    policies: list[str] | None = None,
    policy_file: PolicyFile = None,
    capacity: Count = 8,
    seeds: Count = 1,
    duration: Positive = 30.0,
    size: Count = 230_000,
    scale: Positive = 1.0,
    transport: list[Literal["tcp", "websocket", "zenoh", "ros1", "ros2"]] | None = None,
    rtt: Least0 = 0.0,
    speed: Positive = 1.0,
    out: Path | None = None,
) -> None:
    """Play the same episodes on real sockets and in the simulator.

    Args:
        trace: Bandwidth traces, files or shipped names.
        policies: As in bench (default: drop-oldest,afr,min-motion-gap,learned).
        capacity: L, messages.
        seeds: Episodes on each trace.
        duration: Of each, s.
        size: Of a message, bytes.
        scale: The traces' capacity times this.
        transport: One or more (default: tcp).
        rtt: Round trip of the link, ms.
        speed: Time runs so many times as fast.
        out: Write every run to this folder (JSON).
    """
    from bufgym import traces
    from bufgym.scenario import Uplink
    from bufgym_robot import tunnel as tunnels
    from bufgym_robot import validate as sockets
    from bufgym_robot.margins import margins
    from bufgym_robot.runs import save, table

    load_policies(policy_file)
    chosen = policies_of(policies or ["drop-oldest", "afr", "min-motion-gap", "learned"])
    scenario = Uplink(
        traces=tuple(traces.load(name) for name in trace),
        motion=tuple(traces.load_motion(name) for name in traces.shipped() if name.startswith("drive-")),
        size_bytes=size,
        duration_s=duration,
        scale=(scale,),
        propagation_us=round(rtt * 500),
    )
    transport = transport or ["tcp"]
    about = (
        f"{duration:g} s, {size} bytes at 30 Hz, L = {capacity}, V = {scenario.value.name}, round trip {rtt:g} ms, "
        f"over {', '.join(transport)} and in the simulator"
    )
    with contextlib.ExitStack() as stack:
        tunnel = stack.enter_context(tunnels.opened()) if rtt and not tunnels.impossible() else None
        plays: dict[str, Play] = {name: _play_over(name, tunnel) for name in transport}
        print(f"{about}\n")
        if rtt and tunnel is None:
            print(
                f"note: {tunnels.impossible()}. Instead a proxy delays all bytes. It ends TCP, so it cannot show what"
            )
            print("TCP's own acks and its growing window cost over the round trip.\n")
        runs = sockets.validate(chosen, scenario, capacity, seeds=seeds, plays=plays, speed=speed)
    print("\n".join([table(runs), "", *map(str, margins(runs))]))
    if out is not None:
        again = command_line(
            "bufgym live validate",
            trace=trace,
            policies=policies,
            policy_file=policy_file,
            capacity=capacity,
            seeds=seeds,
            duration=duration,
            size=size,
            scale=scale,
            transport=transport,
            rtt=rtt,
            speed=speed,
        )
        print(f"\nwrote {save(runs, about, again, out)}")


def _play_over(transport: str, tunnel: Tunnel | None) -> Play:
    """Find the player for a transport; raise an error if it is not installed."""
    if transport in ("ros1", "ros2"):
        player: Play = importlib.import_module(f"bufgym_robot.{transport}.episode").player(tunnel)
        return player
    from bufgym_robot import far, validate

    return validate.over(transport) if tunnel is None else far.over(tunnel, transport)


def replay(log: str, /, *, policy_file: PolicyFile = None) -> None:
    """Play a queue's log through the simulator: the same decisions?

    Args:
        log: Log of send --log.
    """
    import bufgym_robot as robot

    load_policies(policy_file)
    played = robot.replay(log)
    stats = played.outcome
    print(
        f"{stats.arrived} put, {stats.delivered} delivered, {stats.dropped} dropped, {stats.in_transmission} in "
        f"transmission, {stats.buffered} queued; QoI {stats.qoi:.3f}, longest gap {stats.longest_gap:g}"
    )
    if played.differences:
        first = "; ".join(played.differences[:3])
        raise BufgymError(f"{log}: the simulator decides otherwise {len(played.differences)} times: {first}")
    print("The simulator makes the same decisions.")


def view(log: Path, /, *, follow: bool = False) -> None:
    """Show what a queue does, from its log: queue, drops, rates, QoI.

    Args:
        log: Log of send --log, even a growing one.
        follow: Show it again as the log grows; Ctrl-C ends it.
    """
    from bufgym_robot import read_log
    from bufgym_robot.view import View

    size_bytes = -1
    while follow or size_bytes < 0:
        seen_bytes, size_bytes = size_bytes, log.stat().st_size if log.exists() else 0
        if size_bytes != seen_bytes:
            redraw(View(read_log(log)).text())
        if follow:
            time.sleep(REDRAW_S)

"""A camera of roscpp under policies, the node unchanged, over a link that fades: the AFR paper's program [wang2022afr].

Frames of 230 kB come at 30 Hz for 20 s into a queue of 15, over 24 Mbit/s with 5 s of 2 Mbit/s in the middle, headers
included, between two network namespaces. Without a round trip the link is the kernel's own (``examples/fade.py``, with
tc's tbf), as on a robot whose own interface is the bottleneck. The kernel has no delay, so a round trip is
``bufgym_robot.tunnel``'s. "stock" is roscpp as it is. Each run under a policy is played again by the simulator
from its log: ``differ`` counts decisions that are not the same. A decision is timed in the node.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import xmlrpc.client
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from bufgym.model import Link
from bufgym.utils.errors import BufgymError
from bufgym_papers.figures.figure import COLOURS, Figure, at_least_0, finish, legend_below, several
from bufgym_papers.figures.rows import FigureRows
from bufgym_robot import read_log, replay, tunnel
from bufgym_robot.programs import running
from studies.round_trips import CAPACITY, RATE_HZ, SIZE_BYTES, V, link

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "packages" / "robot" / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
import fade
import roscpp_cases

MBIT = 24  # Of Ethernet frames, as tc's tbf counts
PAYLOAD = 1448 / 1514  # Share of a frame's bytes
MOST_GAP = 17  # The longest gap that AFR and the agent may leave
WITHIN_US = 10.0  # The paper's Fig. 9 for a decision
LABELS = {"stock": "roscpp as it is"}
LINES = ("other", "drop-oldest", "afr", "orange", "random")  # Colours, in the order of the policies


def impossible() -> str:
    """Why no run can be made here; empty if one can."""
    return tunnel.impossible() or roscpp_cases.missing()


@dataclass(frozen=True)
class KernelLink:
    """What ``tunnel.Tunnel`` is, over a link of the kernel's."""

    near: tunnel.End
    far: tunnel.End

    def carry(self, link: Link, words: Connection) -> None:
        """Give the kernel each of the link's rates in its time, from the time on that comes as words."""
        trace = link.trace
        rates = np.diff(trace.cumulative_bytes) / np.diff(trace.time_us) * 1e6
        began_s = words.recv()
        for at_us, rate in zip(trace.time_us, rates, strict=False):
            time.sleep(max(0.0, began_s + at_us / 1e6 - time.monotonic()))
            fade.shaped(rate)
        signal.pause()


@contextmanager
def kernel_link() -> Iterator[KernelLink]:
    """Make one for a block."""
    robot_at, base_at = (Path("/run/netns", inside[-1]) for inside in (fade.ROBOT, fade.BASE))
    with fade.namespaces(), robot_at.open() as robot, base_at.open() as base:
        fade.shaped(fade.FAST, "add")
        near, far = (tunnel.End(*end) for end in zip(fade.ADDRESSES, (robot.fileno(), base.fileno()), strict=True))
        yield KernelLink(near, far)


@dataclass(frozen=True)
class Reproduction(Figure):
    """Runs of the camera; ``stock`` among the policies is roscpp without one, which differs most from run to run."""

    round_trips_ms: Sequence[float] = (0.0, 50.0)
    policies: Sequence[str] = ("stock", "drop-oldest", "afr", "min-motion-gap", "learned")
    seconds: float = 20.0
    stock_runs: int = 3
    control: str = ""
    """Congestion control of TCP in both namespaces; empty for the machine's."""

    RULES = {"round_trips_ms": several(at_least_0)}

    def simulate(self) -> FigureRows:
        if reason := impossible():
            raise BufgymError(f"afr-roscpp: {reason}")
        with tempfile.TemporaryDirectory() as folder:
            named = ",".join(name for name in self.policies if name != "stock") or "afr"
            built = roscpp_cases.build(Path(folder), named, "Release")
            return FigureRows(
                self._row(built, policy, rtt_ms)
                for rtt_ms in self.round_trips_ms
                for policy in self.policies
                for _ in range(self.stock_runs if policy == "stock" else 1)
            )

    def _row(self, built: Path, policy: str, rtt_ms: float) -> dict[str, Any]:
        """Play the camera once under a policy."""
        with tempfile.TemporaryDirectory() as folder:
            frames = self._frames(built, policy, rtt_ms, Path(folder))
            differ, took_us = None, [np.nan, np.nan]
            for file in Path(folder).glob("*.jsonl"):
                puts_us = [record["took_us"] for record in read_log(file) if record["event"] == "put"]
                differ, took_us = len(replay(file).differences), list(np.quantile(puts_us, [0.5, 0.99]))
        return {
            "rtt_ms": rtt_ms,
            "policy": policy,
            "delivered": len(frames),
            "longest_gap": int(np.diff(frames).max(initial=0)),
            "qoi": V.information(np.array(frames, float)),
            "differ": differ,
            "decision_us": took_us[0],
            "decision_99_us": took_us[1],
        }

    def _frames(self, built: Path, policy: str, rtt_ms: float, log: Path) -> list[int]:
        """The frames that reach the far end."""
        with (tunnel.opened if rtt_ms else kernel_link)() as through, tempfile.TemporaryDirectory() as home:
            for end in (through.near, through.far):
                end.set_congestion_control(self.control or tunnel.congestion_control())
            uri = f"http://{through.near.address}:11311"
            where = {**os.environ, "ROS_MASTER_URI": uri, "ROS_IP": through.near.address, "ROS_HOME": home}
            loaded = {"LD_PRELOAD": str(built), "BUFGYM_POLICY": policy, "BUFGYM_LOG": str(log)}
            words = [str(built.with_name("talker")), "image", str(CAPACITY), str(round(self.seconds * RATE_HZ))]
            words += [str(SIZE_BYTES), str(RATE_HZ)]
            near: dict[str, Any] = {"preexec_fn": through.near.enter, "stdout": subprocess.DEVNULL}
            came: list[int] = []

            def look() -> None:
                through.far.enter()
                with xmlrpc.client.ServerProxy(uri) as master:
                    while not roscpp_cases.publishers(master, "image"):
                        time.sleep(0.1)
                    came.extend(roscpp_cases.seqs(roscpp_cases.subscriber(master, "image"), 10**6, patience_s=15))

            with running(carry=partial(through.carry, link(MBIT * PAYLOAD, self.seconds, True, rtt_ms))) as [carrier]:
                master = subprocess.Popen(["rosmaster", "--core", "-p", "11311"], env=where, **near)
                try:
                    time.sleep(2)
                    viewer = threading.Thread(target=look)
                    viewer.start()
                    carrier.send(time.monotonic() + 2)
                    own = where if policy == "stock" else {**where, **loaded}
                    subprocess.run(words, env=own, stderr=subprocess.DEVNULL, check=True, timeout=200, **near)
                    viewer.join()
                finally:
                    master.kill()
                    master.wait()
        return came

    def tables(self, rows: FigureRows) -> list[str]:
        columns = {"RTT, ms": ("rtt_ms", "g"), "queue": ("policy", ""), "delivered": ("delivered", "")}
        columns |= {"longest gap": ("longest_gap", ""), "QoI": ("qoi", ".1f"), "differ": ("differ", "")}
        columns |= {"us": ("decision_us", ".1f"), "us, 99 %": ("decision_99_us", ".1f")}
        return rows.listing(columns, left=2)

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        ruled = [row for row in rows if row["policy"] != "stock"]
        differ, slowest_us = sum(row["differ"] for row in ruled), max(row["decision_us"] for row in ruled)
        facts: dict[str, Any] = {"same": differ == 0, "differ": differ}
        facts |= {"soon": bool(slowest_us < WITHIN_US), "slowest_us": slowest_us}
        gaps = rows.where(policy="afr") + rows.where(policy="learned")
        facts |= {"gaps": max(row["longest_gap"] for row in gaps) <= MOST_GAP if gaps else None}
        facts["found_gaps"] = ", ".join(f"{row['policy']} {row['longest_gap']}" for row in gaps)
        ratios = {
            (rtt_ms, name): rows.mean("qoi", rtt_ms=rtt_ms, policy=name)
            / rows.mean("qoi", rtt_ms=rtt_ms, policy="stock")
            for rtt_ms in self.round_trips_ms
            for name in ("afr", "learned")
        }
        wanted = {(0.0, "afr"): 1.08, (0.0, "learned"): 1.11, (50.0, "afr"): 1.15, (50.0, "learned"): 1.15}
        asked = [bool(ratios[case] >= least) for case, least in wanted.items() if np.isfinite(ratios.get(case, np.nan))]
        facts["more"] = all(asked) if len(asked) == len(wanted) else None
        facts["ratios"] = ", ".join(f"{name} {ratio:.3f} at {rtt_ms:g} ms" for (rtt_ms, name), ratio in ratios.items())
        return facts

    def draw(self, rows: FigureRows, figure: Any) -> None:
        panels = (("qoi", "QoI"), ("longest_gap", "longest gap, frames"))
        for axes, (column, title) in zip(figure.subplots(1, 2), panels, strict=True):
            for k, policy in enumerate(self.policies):
                places = np.arange(len(self.round_trips_ms)) + 0.8 * (k / len(self.policies) - 0.5)
                colour, label = COLOURS[LINES[k % len(LINES)]], LABELS.get(policy, policy)
                heights = [rows.mean(column, rtt_ms=rtt_ms, policy=policy) for rtt_ms in self.round_trips_ms]
                axes.bar(places, heights, 0.15, color=colour, label=label)
            axes.set_xticks(np.arange(len(self.round_trips_ms)), [f"{ms:g}" for ms in self.round_trips_ms])
            finish(axes, title, xlabel="round trip, ms")
        legend_below(figure, 5, axes)

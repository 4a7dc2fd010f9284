"""A camera of roscpp under policies, the node unchanged, over a link that fades: the AFR paper's program [wang2022afr].

    sudo python -m studies.roscpp --rtt 0 50 --policies stock drop-oldest afr min-motion-gap learned

Frames of 230 kB come at 30 Hz for 20 s into a queue of 15, over 24 Mbit/s with 5 s of 2 Mbit/s in the middle, between
two network namespaces (``bufgym_live.robot.tunnel``). "stock" is roscpp as it is. Each run under a policy is played
again by the simulator from its log: ``differ`` counts decisions that are not the same. ``us`` is the median time of a
decision in the node, and its 99th percentile.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
import xmlrpc.client
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bufgym_live.robot import read_log, replay, tunnel
from bufgym_live.robot.programs import running
from studies.round_trips import CAPACITY, RATE_HZ, SIZE_BYTES, V, link
from website.markdown import table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "packages" / "live" / "tests" / "robot"))
import roscpp_cases

SECONDS = 20.0
POLICIES = ("stock", "drop-oldest", "afr", "min-motion-gap", "learned")
HEAD = ("RTT, ms", "queue", "delivered", "longest gap", "QoI", "differ", "us", "us, 99 %")


def frames_of(built: Path, policy: str, round_trip_ms: float, log: Path) -> list[int]:
    """The frames that reach the far end."""
    with tunnel.opened() as through, tempfile.TemporaryDirectory() as home:
        uri = f"http://{through.near.address}:11311"
        where = {**os.environ, "ROS_MASTER_URI": uri, "ROS_IP": through.near.address, "ROS_HOME": home}
        if policy != "stock":
            where |= {"LD_PRELOAD": str(built), "BUFGYM_POLICY": policy, "BUFGYM_LOG": str(log)}
        words = [str(built.with_name("talker")), "image", str(CAPACITY), str(round(SECONDS * RATE_HZ))]
        words += [str(SIZE_BYTES), str(RATE_HZ)]
        settings: dict[str, Any] = {"env": where, "preexec_fn": through.near.enter, "stdout": subprocess.DEVNULL}
        came: list[int] = []

        def look() -> None:
            through.far.enter()
            with xmlrpc.client.ServerProxy(uri) as master:
                while not roscpp_cases.publishers(master, "image"):
                    time.sleep(0.1)
                came.extend(roscpp_cases.seqs(roscpp_cases.subscriber(master, "image"), 10**6, patience_s=15))

        fade = link(24, SECONDS, True, round_trip_ms)
        with running(carry=partial(through.carry, fade)) as [carrier]:
            master = subprocess.Popen(["rosmaster", "--core", "-p", "11311"], **{**settings, "env": where})
            try:
                time.sleep(2)
                viewer = threading.Thread(target=look)
                viewer.start()
                carrier.tell(time.monotonic() + 2)
                subprocess.run(words, **settings, check=True, timeout=200)
                viewer.join()
            finally:
                master.kill()
                master.wait()
    return came


def cells(built: Path, policy: str, round_trip_ms: float) -> tuple[str, ...]:
    """A row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        frames = frames_of(built, policy, round_trip_ms, Path(folder))
        told: tuple[str, ...] = ("", "", "")
        for file in Path(folder).glob("*.jsonl"):
            took_us = [record["took_us"] for record in read_log(file) if record["event"] == "put"]
            again = replay(file)
            told = (str(len(again.differences)), *(f"{us:.1f}" for us in np.quantile(took_us, [0.5, 0.99])))
    gap, information = int(np.diff(frames).max(initial=0)), V.information(np.array(frames, float))
    return (f"{round_trip_ms:g}", policy, str(len(frames)), str(gap), f"{information:.1f}", *told)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rtt", type=float, nargs="+", default=[0.0, 50.0], help="round trips, ms")
    parser.add_argument("--policies", nargs="+", default=POLICIES, help="stock is roscpp as it is")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        named = ",".join(sorted({*options.policies} - {"stock"}) or ["afr"])
        built = roscpp_cases.build(Path(folder), named, "Release")
        rows = []
        for rtt in options.rtt:
            for policy in options.policies:
                rows.append(cells(built, policy, rtt))
                print(*rows[-1], sep="\t", file=sys.stderr, flush=True)
        print(table(HEAD, rows))


if __name__ == "__main__":
    main()

"""How many frames of its animation the page drops: Chromium's own trace of it, with robots that publish made-up senses.

python tests/relay/frames.py --robots 20 --seconds 10

Needs Playwright and a Chromium. The relay has a process of its own, with robots whose messages are made beforehand: a
pose, a scan and a picture ten times a second each. ``--robots 0``: what the machine drops of an empty page.
"""

import argparse
import asyncio
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright
from relay_cases import client, settings

from bufgym.relay import policies, ros_messages
from bufgym.relay.config import Limits
from bufgym.relay.room import cast, jpeg, picture, pose_at
from bufgym.relay.server import Server

RATE_HZ, POSES, SETTLES_S = 10, 40, 6.0
SENSES = {"odom": ("cdr", ros_messages.ODOMETRY), "scan": ("cdr", ros_messages.SCAN), "camera": ("jpeg", "")}
CATEGORIES = ["devtools.timeline", "disabled-by-default-devtools.timeline.frame", "cc", "benchmark"]
ANGLES = np.radians(np.arange(0, 360, 2.0))


async def robot(port: int, number: int) -> None:
    """One that drives its first four seconds again and again, with its status and a queue that fills and empties."""
    name = f"robot-{number}"
    drive = [pose_at(number, k / RATE_HZ) for k in range(POSES)]
    frame = jpeg(picture(drive[0]))
    senses = [
        (
            ros_messages.odometry(0, name, pose, 1.0),
            ros_messages.scan(0, name, ANGLES, cast(pose, ANGLES)[0]),
            frame,
        )
        for pose in drive
    ]
    kinds = {topic: {"encoding": encoding, "type": type} for topic, (encoding, type) in SENSES.items()}
    async with client(port, name=name) as one:
        began_s = time.monotonic() + number / 200

        async def say(topic: str, data: Any) -> None:
            await one.put(f"/robots/{name}/{topic}", json.dumps(data).encode(), encoding="json")

        for k in range(10**9):
            await asyncio.sleep(max(0.0, began_s + k / RATE_HZ - time.monotonic()))
            for (topic, (encoding, type)), payload in zip(SENSES.items(), senses[k % POSES], strict=True):
                await one.put(f"/robots/{name}/{topic}", payload, encoding=encoding, type=type)
            topics = {topic: {"put": k, "left": k, "dropped": 0, "age_s": 0.1, "qoi": 0.9} for topic in SENSES}
            queue = {"policy": "afr", "capacity": 16, "queued": k % 16, "waiting": [n % 3 for n in range(k % 16)]}
            queue |= {"put": 3 * k, "left": 2 * k, "dropped": k, "rate_bps": 5e5, "qoi": 0.9, "topics": topics}
            if k % 2 == 0:
                await say("queue", queue)
            if k % RATE_HZ == 0:
                await say("status", {"battery": 0.7, "queue": queue, "publishes": kinds, "policies": ["afr"]})


async def serve(robots: int) -> None:
    server = Server(settings(limits=Limits(connections=1_000)))
    port = await server.start()
    await asyncio.to_thread(policies.warm, server.config.policies[0])
    print(port, flush=True)
    await asyncio.gather(asyncio.Event().wait(), *(robot(port, number) for number in range(robots)))


def traced(port: int, robots: int, seconds: float) -> Iterator[dict[str, Any]]:
    """The events of the trace."""
    with sync_playwright() as play, tempfile.TemporaryDirectory() as folder:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": 1360, "height": 800})
        began_s = time.monotonic()
        page.goto(f"http://127.0.0.1:{port}/")
        while robots and not page.evaluate("document.querySelectorAll('.card').length"):
            page.wait_for_timeout(10)
        print(f"first robot after {time.monotonic() - began_s:.2f} s" if robots else "no robots")
        page.wait_for_timeout(1000 * SETTLES_S)
        path = Path(folder, "trace.json")
        browser.start_tracing(page=page, path=path, categories=CATEGORIES)
        page.wait_for_timeout(1000 * seconds)
        browser.stop_tracing()
        browser.close()
        yield from json.loads(path.read_bytes())["traceEvents"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        asyncio.run(serve(options.robots))
        return
    words = [sys.executable, __file__, "--serve", "--robots", str(options.robots)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as relay:
        assert relay.stdout is not None
        try:
            events = list(traced(int(relay.stdout.readline()), options.robots, options.seconds))
        finally:
            relay.kill()
    begun, dropped = (sum(event["name"] == name for event in events) for name in ("BeginFrame", "DroppedFrame"))
    print(f"{dropped} of {begun} frames dropped")
    ours = [event.get("tdur", 0) / 1e3 for event in events if event["name"] == "FireAnimationFrame"]
    median, late, longest = np.percentile(ours, [50, 99, 100])
    print(f"drawing takes {median:.1f} ms of a processor (median; p99 {late:.1f}, longest {longest:.1f})")


if __name__ == "__main__":
    main()

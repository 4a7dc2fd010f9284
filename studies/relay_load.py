"""How fast relays are, and their page.

python -m studies.relay_load load --robots 20 --viewers 5 --seconds 60 [--slow] [--flood] [--replays 6]
python -m studies.relay_load idle --connections 1000
python -m studies.relay_load page --robots 20 --seconds 10   # frames that the page drops; needs Playwright, Chromium
python -m studies.relay_load page --robots 907 --rate-hz 0.5   # more than one process can send for ten times a second
python -m studies.relay_load page --robots 1 --points 100000   # the 3-D tab, with so large a cloud in each turn

A relay is the command ``bufgym relay serve``; all else shares another process. Robots send messages that are made
beforehand. ``page --robots 0`` says what the machine drops of an empty page.
"""

import argparse
import asyncio
import contextlib
import json
import os
import shutil
import struct
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

REPO = Path(__file__).resolve().parent.parent
# It shares robots with the examples, and a relay's settings and clouds with the tests.
SHARED = ("packages/robot/tests", "packages/relay/tests", "tests", "examples")
sys.path[:0] = [str(REPO / name) for name in SHARED]

import page_cases
from loop_cases import beside as beside
from made_up_robot import ODOMETRY, SCAN, cast, jpeg, odometry, picture, pose_at, scan
from relay_cases import client

from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import Message

SIZE_BYTES, RATE_HZ, MEMORY_S = 50_000, 10, 30.0
_BINARY, _PING, _PONG, _MASKED = 0x82, 0x89, 0x8A, 0x80
CONFIG = """port = 0
[[rules]]
send = true
receive = true
address = "127.0.0.0/8"
topic = ".*"
[limits]
connections = 10000
all_connections = 10000
sessions = 10000
subscriptions = 10000
"""
RECORDER = '[[rules]]\nrecorder = true\nreceive = true\ntopic = ".*"\n'


async def served(config: str, folder: Path) -> tuple[asyncio.subprocess.Process, int]:
    """A relay with this configuration, and its port."""
    folder.mkdir(exist_ok=True)
    (folder / "relay.toml").write_text(config)
    words = ("-m", "bufgym", "relay", "serve", "--config", str(folder / "relay.toml"))
    one = await asyncio.create_subprocess_exec(sys.executable, *words, stdout=-1)
    assert one.stdout is not None
    said = (await one.stdout.readline()).decode()
    return one, int(said.partition("/ is")[0].rpartition(":")[2])


@contextlib.asynccontextmanager
async def relay(records: bool = False) -> Any:
    """The number of its process, and its port."""
    with tempfile.TemporaryDirectory() as folder:
        config = f'folder = "{folder}/held"\n{CONFIG}{RECORDER}' if records else CONFIG
        one, port = await served(config, Path(folder))
        try:
            yield one.pid, port
        finally:
            one.kill()
            await one.wait()


def cpu_s(pid: int) -> float:
    times = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")


def megabytes(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 1e6


async def each(rate_hz: float, count: int, first_s: float = 0.0) -> Any:
    """0, 1, 2 ..., so many a second."""
    began_s = time.monotonic() + first_s
    for k in range(count):
        await asyncio.sleep(max(0.0, began_s + k / rate_hz - time.monotonic()))
        yield k


async def idle(connections: int) -> None:
    async with relay() as (pid, port), contextlib.AsyncExitStack() as stack:
        times_s, before = [], megabytes(pid)
        for _ in range(connections):
            began_s = time.perf_counter()
            one = await stack.enter_async_context(client(port))
            await one.subscribe("^/robots/")
            times_s.append(time.perf_counter() - began_s)
        median, late = np.percentile(times_s, [50, 99]) * 1e3
        memory = f"{before:.0f} -> {megabytes(pid):.0f} MB"
        print(f"{connections} connections: {memory}; {median:.1f} ms a new one, p99 {late:.1f}")


async def view(port: int, slowly: bool, latency_us: list[int]) -> None:
    """Note how late messages are. A viewer reads no more of a frame than its header, a slow one takes 100 kB/s."""
    async with client(port, receive_buffer_bytes=65_536 if slowly else None, name="viewer") as one:
        await one.subscribe("^/robots/")
        while slowly:
            message = await one.next()
            if isinstance(message, Message):
                latency_us.append(time.time_ns() // 1000 - message.stamp_us)
                await asyncio.sleep(SIZE_BYTES / 1e5)
        reader, transport = asyncio.StreamReader(2**18), one.socket.transport
        reader.set_transport(transport)
        transport.set_protocol(asyncio.StreamReaderProtocol(reader))
        try:
            while True:
                kind, size = await reader.readexactly(2)
                if size >= 126:
                    size = int.from_bytes(await reader.readexactly(2 if size == 126 else 8))
                data = await reader.readexactly(size)
                if kind == _BINARY:
                    latency_us.append(time.time_ns() // 1000 - int(struct.unpack_from("!q", data, 24)[0]))
                elif kind == _PING:
                    transport.write(bytes([_PONG, _MASKED | size]) + bytes(4) + data)
        finally:
            transport.set_protocol(one.socket)  # which knows how to end


async def publish(port: int, k: int, robots: int, seconds: float) -> None:
    """Frames with 0 for a mask, of which only the stamp changes."""
    data = wire.encode(Message(f"/robots/{k}/camera", os.urandom(SIZE_BYTES), "raw"))
    frame = bytearray(bytes([_BINARY, _MASKED | 127]) + struct.pack("!Q", len(data)) + bytes(4) + data)
    async with client(port, name=f"robot-{k}") as one:
        async for _ in each(RATE_HZ, round(seconds * RATE_HZ), k / robots / RATE_HZ):
            struct.pack_into("!q", frame, 14 + 24, time.time_ns() // 1000)
            one.socket.transport.write(bytes(frame))


async def flood(port: int) -> None:
    """Publish JSON of 100 kB from another address, as fast as it is taken."""
    async with client(port, local="127.0.0.2", name="flood") as one:
        while True:
            await one.put("/flood", json.dumps("x" * 100_000).encode(), encoding="json")


async def replay(port: int, k: int) -> None:
    """Ask for the first 4 MiB of the recording, again and again."""
    async with client(port, local="127.0.0.3", name=f"replay-{k}") as one:
        await one.say("recordings")
        while not (files := (await one.next())["files"]):
            await asyncio.sleep(0.1)
            await one.say("recordings")
        while True:
            await one.say("replay", id="r", file=files[-1]["name"], from_us=0, most_bytes=2**22)
            await one.next()


async def load(robots: int, viewers: int, seconds: float, slow: bool, loud: bool, replays: int | None) -> None:
    latency_us: list[list[int]] = [[] for _ in range(viewers)]
    memory_mb: list[float] = []

    async def watch() -> None:
        while True:
            await asyncio.sleep(MEMORY_S)
            memory_mb.append(megabytes(pid))

    async with relay(records=replays is not None) as (pid, port):
        views = [view(port, slow and k == 0, latency_us[k]) for k in range(viewers)]
        others = [replay(port, k) for k in range(replays or 0)] + ([flood(port)] if loud else [])
        async with beside(*views, watch(), *others):
            await asyncio.sleep(5.0)  # until the policy is compiled
            began_s, began_cpu_s, before = time.monotonic(), cpu_s(pid), megabytes(pid)
            await asyncio.gather(*(publish(port, k, robots, seconds) for k in range(robots)))
            cores = (cpu_s(pid) - began_cpu_s) / (time.monotonic() - began_s)
            await asyncio.sleep(1.0)
        print(f"{robots} robots, {viewers} viewers: {cores:.2f} cores, {before:.0f} -> {megabytes(pid):.0f} MB")
    print(f"every {MEMORY_S:g} s: {' '.join(f'{mb:.0f}' for mb in memory_mb)} MB")
    for k, times_us in enumerate(latency_us):
        median, late, longest = np.percentile(times_us, [50, 99, 100]) / 1e3
        of = round(seconds * RATE_HZ) * robots
        print(f"viewer {k}: {len(times_us)} of {of}, {median:.2f} ms, p99 {late:.2f}, longest {longest:.0f}")


DRIVE_S, SETTLES_S, COMING_HZ = 4, 6.0, 100  # so many robots come in a second
SENSES = {"odom": ("cdr", ODOMETRY), "scan": ("cdr", SCAN), "camera": ("jpeg", "")}
CLICK = """new Promise(shown => {
  const card = [...document.querySelectorAll(".card")].at(-1), began = performance.now();
  card.click();
  requestAnimationFrame(function look() {
    const isShown = document.querySelector("#name").textContent === card.querySelector(".called").textContent;
    requestAnimationFrame(isShown ? () => shown(performance.now() - began) : look);
  });
})"""
"""Milliseconds from a click on the last card to the frame after the one that shows its robot."""
CATEGORIES = ["devtools.timeline", "disabled-by-default-devtools.timeline.frame", "cc", "benchmark"]
ANGLES = np.radians(np.arange(0, 360, 2.0))


def cloud(count: int) -> bytes:
    """Points with brightness, laid out as Velodyne's driver does: 22 bytes each."""
    names, formats = ["x", "y", "z", "intensity", "ring", "time"], ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"]
    points = np.zeros(count, np.dtype(list(zip(names, formats, strict=True))))
    for k, name in enumerate(names[:4]):
        points[name] = np.random.default_rng(k).normal(0, 10, count)
    message: bytes = page_cases.cloud(points, "base_link")
    return message


def driven(number: int, rate_hz: float) -> list[tuple[bytes, bytes, bytes]]:
    """What a robot senses in its first four seconds, in the order of ``SENSES``."""
    drive = [pose_at(number, k / rate_hz) for k in range(max(1, round(DRIVE_S * rate_hz)))]
    places = [odometry(0, f"robot-{number}", pose, 1.0) for pose in drive]
    scans = [scan(0, f"robot-{number}", ANGLES, cast(pose, ANGLES)[0]) for pose in drive]
    return list(zip(places, scans, [jpeg(picture(drive[0]))] * len(drive), strict=True))


async def robot(port: int, number: int, rate_hz: float, points: int, senses: list[tuple[bytes, bytes, bytes]]) -> None:
    """One that drives its first four seconds again and again, with its status and a queue that fills and empties."""
    await asyncio.sleep(number / COMING_HZ)
    name = f"robot-{number}"
    kinds = {topic: {"encoding": encoding, "type": type} for topic, (encoding, type) in SENSES.items()}
    seen = cloud(points) if points and number == 0 else b""
    if seen:
        kinds["velodyne"] = {"encoding": "cdr", "type": page_cases.CLOUD}
    async with client(port, name=name) as one:

        async def say(topic: str, data: Any) -> None:
            await one.put(f"/robots/{name}/{topic}", json.dumps(data).encode(), encoding="json")

        async for k in each(rate_hz, 10**9):
            for (topic, (encoding, type)), payload in zip(SENSES.items(), senses[k % len(senses)], strict=True):
                await one.put(f"/robots/{name}/{topic}", payload, encoding=encoding, type=type)
            topics = {topic: {"put": k, "left": k, "dropped": 0, "age_s": 0.1, "qoi": 0.9} for topic in SENSES}
            queue = {"policy": "afr", "capacity": 16, "queued": k % 16, "waiting": [n % 3 for n in range(k % 16)]}
            queue |= {"put": 3 * k, "left": 2 * k, "dropped": k, "rate_bps": 5e5, "qoi": 0.9, "topics": topics}
            if seen:
                await one.put(f"/robots/{name}/velodyne", seen, encoding="cdr", type=page_cases.CLOUD)
            if k % 2 == 0:
                await say("queue", queue)
            if k % max(1, round(rate_hz)) == 0:
                await say("status", {"battery": 0.7, "queue": queue, "publishes": kinds, "policies": ["afr"]})


async def traced(port: int, robots: int, seconds: float, points: int) -> Any:
    """The events of Chromium's trace of the page. Says how long it takes to the first robot and to one clicked on."""
    from playwright.async_api import async_playwright

    words: dict[str, Any] = {"executable_path": shutil.which("chromium"), "args": ["--no-sandbox", "--disable-gpu"]}
    async with async_playwright() as play, await play.chromium.launch(**words) as browser:
        page = await browser.new_page(viewport={"width": 1360, "height": 800})
        began_s = time.monotonic()
        await page.goto(f"http://127.0.0.1:{port}/" + ("#/robot/robot-0/3d" if points else ""))
        while robots and not await page.evaluate("document.querySelectorAll('.card').length"):
            await page.wait_for_timeout(10)
        print(f"first robot after {time.monotonic() - began_s:.2f} s" if robots else "no robots")
        await page.wait_for_timeout(1000 * SETTLES_S)
        await browser.start_tracing(page=page, categories=CATEGORIES)
        await page.wait_for_timeout(1000 * seconds)
        events = json.loads(await browser.stop_tracing())["traceEvents"]
        if robots > 1:
            cards = await page.evaluate("document.querySelectorAll('.card').length")
            print(f"{cards} robots in the list; a click shows its robot after {await page.evaluate(CLICK):.0f} ms")
        if points:
            print(await page.text_content("#space figcaption"))
        return events


async def page(robots: int, seconds: float, rate_hz: float, points: int) -> None:
    drives = [driven(number, rate_hz) for number in range(robots)]
    async with relay() as (_, port), beside(*(robot(port, k, rate_hz, points, drives[k]) for k in range(robots))):
        await asyncio.sleep(5.0 + robots / COMING_HZ)  # until the policy is compiled
        events = await traced(port, robots, seconds, points)
    begun, dropped = (sum(event["name"] == name for event in events) for name in ("BeginFrame", "DroppedFrame"))
    print(f"{dropped} of {begun} frames dropped; load {os.getloadavg()[0]:.0f} on {os.cpu_count()} processors")
    for name, what in (("FireAnimationFrame", "drawing"), ("FunctionCall", "each call of the page's script")):
        ours = [event["tdur"] / 1e3 for event in events if event["name"] == name and "tdur" in event]
        median, late, longest = np.percentile(ours or [0], [50, 99, 100])
        print(
            f"{what}: {median:.1f} ms of a processor (median; p99 {late:.1f}, longest {longest:.1f}), {len(ours)} times"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    verbs = parser.add_subparsers(required=True)
    for work in (load, idle, page):
        verbs.add_parser(work.__name__).set_defaults(work=work)
    of = verbs.choices
    for verb in ("load", "page"):
        of[verb].add_argument("--robots", type=int, default=20)
        of[verb].add_argument("--seconds", type=float, default=10.0)
    of["page"].add_argument("--rate-hz", type=float, default=RATE_HZ, help="how often each robot says all it says")
    of["page"].add_argument("--points", type=int, default=0, help="of a cloud that the first robot sends each time")
    of["load"].add_argument("--viewers", type=int, default=3)
    of["load"].add_argument("--slow", action="store_true", help="the first viewer reads 100 kB/s")
    of["load"].add_argument("--flood", dest="loud", action="store_true", help="another client floods it with JSON")
    of["load"].add_argument("--replays", type=int, help="the relay records all, and so many clients ask for replays")
    of["idle"].add_argument("--connections", type=int, default=1000)
    options = vars(parser.parse_args())
    asyncio.run(options.pop("work")(**options))


if __name__ == "__main__":
    main()

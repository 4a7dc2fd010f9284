"""Three relays over NATS, of which one is killed every ten seconds.

python -m studies.relay_mesh --robots 60 --viewers 20 --seconds 60

Robots and viewers are spread over the relays. Each robot sends pictures of 20 kB twice a second. A viewer watches three
robots, of all relays. An operator at each relay sends commands to robots of all relays, two a second. A killed relay
starts again at once; another stands in for it meanwhile. Needs nats-server.
"""

import argparse
import asyncio
import contextlib
import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

from studies import relay_load

from nats_cases import nats_server  # isort: skip  (relay_load has made it known)

from bufgym.ground.errors import BufgymError
from bufgym.model.topics import Topic
from bufgym_live.relay.client import RobotClient
from bufgym_live.relay.session import Session
from bufgym_live.robot.sockets import free_port

RELAYS, RATE_HZ, SIZE_BYTES, KILL_S, COMMAND_S = 3, 2.0, 20_000, 10.0, 0.5
SHARED = """
[[rules]]
nats = true
send = true
receive = true
topic = "/robots/.*"
[nats]
url = "nats://127.0.0.1:{nats}"
name = "{name}"
"""


async def started(port: int, nats: int, folder: Path) -> asyncio.subprocess.Process:
    config = relay_load.CONFIG.replace("port = 0", f'port = {port}\nfolder = "held"')
    one, _ = await relay_load.served(config + SHARED.format(nats=nats, name=folder.name), folder)
    return one


async def mesh(robots: int, viewers: int, seconds: float) -> None:
    folder, nats, ports = (
        Path(tempfile.mkdtemp()),
        free_port("127.0.0.1"),
        [free_port("127.0.0.1") for _ in range(RELAYS)],
    )
    stack = contextlib.AsyncExitStack()
    await stack.enter_async_context(nats_server(nats, folder / "nats"))
    words = [(ports[k], nats, folder / f"relay-{k}") for k in range(RELAYS)]
    relays = [await started(*each) for each in words]
    url = [",".join(f"ws://127.0.0.1:{port}" for port in ports[k:] + ports[:k]) for k in range(RELAYS)]
    came: list[list[Any]] = [[] for _ in range(robots)]
    sent: list[list[Any]] = [[] for _ in range(robots)]
    gaps_s, last_s = [0.0] * viewers, [0.0] * viewers
    refused = 0

    def seen(k: int) -> None:
        now_s = time.monotonic()
        gaps_s[k] = max(gaps_s[k], now_s - last_s[k]) if last_s[k] else 0.0
        last_s[k] = now_s

    async def drive(k: int) -> None:
        camera, picture = f"/robots/{k}/camera", bytes(SIZE_BYTES)
        robot = RobotClient(url[k % RELAYS], f"robot-{k}", topics=(Topic(camera),), policy="drop-oldest", capacity=4)
        robot.subscribe(f"^/robots/{k}/command$", lambda m: came[k].append(json.loads(bytes(m.payload))), durable=True)
        running = asyncio.create_task(robot.run())
        async for _ in relay_load.each(RATE_HZ, 10**9, k / robots / RATE_HZ):
            robot.publish(camera, picture, "jpeg")
            if running.done():
                running.result()

    async def watch(k: int) -> None:
        viewer = Session(url[k % RELAYS], f"viewer-{k}")
        watched = "|".join(str((k + step * 7) % robots) for step in range(3))
        viewer.subscribe(f"^/robots/({watched})/camera$", lambda message: seen(k))
        await viewer.run()

    async def operate(k: int) -> None:
        nonlocal refused
        operator, number = Session(url[k], f"operator-{k}"), 0
        running = asyncio.create_task(operator.run())
        try:
            while True:
                await asyncio.sleep(COMMAND_S)
                to = (7 * number + k) % robots
                try:
                    await operator.command(f"/robots/{to}/command", [k, number])
                    sent[to].append([k, number])
                except BufgymError:
                    refused += 1
                number += 1
        finally:
            running.cancel()

    async with asyncio.TaskGroup() as group:
        moving = [group.create_task(drive(k)) for k in range(robots)] + [
            group.create_task(watch(k)) for k in range(viewers)
        ]
        await asyncio.sleep(8.0)
        giving = [group.create_task(operate(k)) for k in range(RELAYS)]
        gaps_s[:] = [0.0] * viewers
        until_s, k, down_s = time.monotonic() + seconds, 0, []
        while time.monotonic() < until_s:
            await asyncio.sleep(KILL_S)
            began_s = time.monotonic()
            relays[k].kill()
            await relays[k].wait()
            relays[k] = await started(*words[k])
            down_s.append(time.monotonic() - began_s)
            k = (k + 1) % RELAYS
        for task in giving:
            task.cancel()
        await asyncio.sleep(8.0)
        used = [(relay_load.cpu_s(each.pid), relay_load.megabytes(each.pid)) for each in relays]
        for task in moving:
            task.cancel()
    for each in relays:
        each.kill()
        await each.wait()
    await stack.aclose()
    shutil.rmtree(folder, ignore_errors=True)
    acked, arrived = sum(map(len, sent)), sum(map(len, came))
    lost = sum(one not in came[k] for k, each in enumerate(sent) for one in each)
    twice = sum(each.count(one) - 1 for each in came for one in map(list, {tuple(one) for one in each}))
    print(
        f"{len(down_s)} kills, a relay down for {min(down_s):.1f} to {max(down_s):.1f} s; "
        f"{acked} commands acked, {refused} refused"
    )
    print(f"{arrived} arrived, {lost} of the acked lost, {twice} twice")
    print(
        f"longest time without a picture: {max(gaps_s):.1f} s over {viewers} viewers "
        f"(median {sorted(gaps_s)[viewers // 2]:.1f})"
    )
    print("relays: " + ", ".join(f"{cpu:.0f} s of CPU, {mb:.0f} MB" for cpu, mb in used))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--robots", type=int, default=60)
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0)
    asyncio.run(mesh(**vars(parser.parse_args())))


if __name__ == "__main__":
    main()

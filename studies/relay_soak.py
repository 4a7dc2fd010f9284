"""Three relays over NATS for minutes, with kills of relays and with stalls of NATS.

python -m studies.relay_soak --minutes 60 --robots 60 --viewers 20
python -m studies.relay_soak --minutes 1 --stall 0   # kills alone

Robots and viewers are spread over the relays. Each robot sends pictures of 20 kB twice a second. A viewer watches three
robots, one at each relay. An operator at each relay sends commands to robots of all relays, two a second. Every ten
seconds one relay of the last two is killed, and starts again at once; another stands in for it meanwhile. The first
relay lives on, so that its memory can be watched. Every minute NATS is stopped (SIGSTOP) for ``--stall`` seconds.
Commands may be executed for a minute, longer than any break: with a shorter deadline some would rightly be withdrawn
after their ack. The last ones are waited for as long. Needs nats-server. Prints a line for each promise, PASS or FAIL,
and for each lost command when it was acked.
"""

import argparse
import asyncio
import contextlib
import itertools
import json
import signal
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from studies import relay_load

from nats_cases import nats_server  # isort: skip  (relay_load has made it known)

from bufgym.model.topics import Topic
from bufgym.utils.errors import BufgymError
from bufgym_robot.fleet.client import RobotClient
from bufgym_robot.wire.messages import UNKNOWN
from bufgym_robot.wire.session import Session
from bufgym_robot.wire.sockets import free_port

RELAYS, RATE_HZ, SIZE_BYTES, COMMAND_S, DEADLINE_S = 3, 2.0, 20_000, 0.5, 60
KILL_S, STALL_EVERY_S, SETTLES_S, SAMPLE_S = 10.0, 60.0, 8.0, 5.0
MOST_GAP_S, MOST_GROWTH_MB = 2.0, 20.0
SHARED = """
[[rules]]
nats = true
send = true
receive = true
topic = "/robots/.*"
command_s = {deadline_s}
[nats]
url = "nats://127.0.0.1:{nats}"
name = "{name}"
"""


class Soak:
    """What goes on over the relays, and what came of it."""

    def __init__(self, folder: Path, robots: int, viewers: int, stall_s: float) -> None:
        self.folder, self.robots, self.stall_s = folder, robots, stall_s
        self.nats_port, *self.ports = (free_port("127.0.0.1") for _ in range(1 + RELAYS))
        self.urls = [",".join(f"ws://127.0.0.1:{p}" for p in self.ports[k:] + self.ports[:k]) for k in range(RELAYS)]
        self.relays: list[asyncio.subprocess.Process] = []
        self.acked, self.came = dict[tuple[int, int, int], float](), Counter[tuple[int, int, int]]()
        self.refused, self.ended, self.began_s = set[tuple[int, int, int]](), 0, time.monotonic()
        self.gaps_s, self.last_s = [0.0] * viewers, [0.0] * viewers
        self.down_s, self.memory_mb = list[float](), list[float]()

    async def started(self, k: int) -> asyncio.subprocess.Process:
        config = relay_load.CONFIG.replace("port = 0", f'port = {self.ports[k]}\nfolder = "held"')
        config = config.replace("send = true", f"send = true\ncommand_s = {DEADLINE_S}")
        name = f"relay-{k}"
        one, _ = await relay_load.served(
            config + SHARED.format(nats=self.nats_port, name=name, deadline_s=DEADLINE_S), self.folder / name
        )
        return one

    async def drive(self, k: int) -> None:
        """One robot's program; it counts the end of its client."""
        camera, picture = f"/robots/{k}/camera", bytes(SIZE_BYTES)
        robot = RobotClient(self.urls[k % RELAYS], f"robot-{k}", topics=(Topic(camera),), policy="drop-oldest")

        def take(message: Any) -> None:
            self.came[(k, *json.loads(bytes(message.payload)))] += 1

        async def run() -> None:
            try:
                await robot.run()
            except Exception:
                self.ended += 1

        robot.subscribe(f"^/robots/{k}/command$", take, durable=True)
        async with relay_load.beside(run()):
            async for _ in relay_load.each(RATE_HZ, 10**9, k / self.robots / RATE_HZ):
                robot.publish(camera, picture, "jpeg")

    async def watch(self, k: int) -> None:
        """One viewer; it notes its longest time without a picture."""

        def see(message: Any) -> None:
            now_s = time.monotonic()
            self.gaps_s[k] = max(self.gaps_s[k], now_s - (self.last_s[k] or now_s))
            self.last_s[k] = now_s

        viewer = Session(self.urls[k % RELAYS], f"viewer-{k}")
        watched = "|".join(str((k + step * 7) % self.robots) for step in range(3))
        viewer.subscribe(f"^/robots/({watched})/camera$", see)
        await viewer.run()

    async def operate(self, k: int) -> None:
        """One operator; it notes which of its commands a relay has acked."""
        operator = Session(self.urls[k], f"operator-{k}")
        async with relay_load.beside(operator.run()):
            for number in itertools.count():
                await asyncio.sleep(COMMAND_S)
                to = (7 * number + k) % self.robots
                try:
                    await operator.command(f"/robots/{to}/command", [k, number])
                    self.acked[(to, k, number)] = time.monotonic()
                except BufgymError as error:
                    if UNKNOWN not in str(error):  # then it may have been executed
                        self.refused.add((to, k, number))

    async def kill(self, until_s: float) -> None:
        for k in itertools.cycle(range(1, RELAYS)):
            await asyncio.sleep(KILL_S)
            if time.monotonic() > until_s:
                return
            began_s = time.monotonic()
            self.relays[k].kill()
            await self.relays[k].wait()
            self.relays[k] = await self.started(k)
            self.down_s.append(time.monotonic() - began_s)

    async def stall(self, nats: asyncio.subprocess.Process) -> None:
        while self.stall_s:
            await asyncio.sleep(STALL_EVERY_S / 2)
            nats.send_signal(signal.SIGSTOP)
            try:
                await asyncio.sleep(self.stall_s)
            finally:
                nats.send_signal(signal.SIGCONT)
            await asyncio.sleep(STALL_EVERY_S / 2)

    async def measure(self) -> None:
        while True:
            self.memory_mb.append(relay_load.megabytes(self.relays[0].pid))
            await asyncio.sleep(SAMPLE_S)

    async def run(self, minutes: float) -> None:
        async with nats_server(self.nats_port, self.folder / "nats") as nats:
            try:
                for k in range(RELAYS):
                    self.relays.append(await self.started(k))
                moving = [self.drive(k) for k in range(self.robots)] + [self.watch(k) for k in range(len(self.gaps_s))]
                async with relay_load.beside(*moving):
                    await asyncio.sleep(SETTLES_S)
                    self.gaps_s = [0.0] * len(self.gaps_s)
                    async with relay_load.beside(*(self.operate(k) for k in range(RELAYS)), self.measure()) as giving:
                        async with relay_load.beside(self.stall(nats)):
                            await self.kill(time.monotonic() + 60.0 * minutes)
                        for task in giving[:RELAYS]:
                            task.cancel()
                        until_s = time.monotonic() + DEADLINE_S
                        while self.lost() and time.monotonic() < until_s:
                            await asyncio.sleep(1.0)
                        await asyncio.sleep(SETTLES_S)  # for what might come twice
            finally:
                for one in self.relays:
                    with contextlib.suppress(ProcessLookupError):
                        one.kill()
                    await one.wait()

    def lost(self) -> dict[tuple[int, int, int], float]:
        """Commands that no robot has had, and when they were acked."""
        return {one: at_s for one, at_s in self.acked.items() if one not in self.came}

    def report(self) -> None:
        """Print what was promised, and whether it was kept."""
        lost, twice = self.lost(), sum(n - 1 for n in self.came.values())
        for (robot, operator, number), at_s in lost.items():
            after_s = at_s - self.began_s
            print(f"lost: command {number} of operator {operator} to robot {robot}, acked after {after_s:.0f} s")
        silent, growth_mb = max(self.gaps_s), max(self.memory_mb) - self.memory_mb[0]
        print(f"{len(self.down_s)} kills, a relay down for {max(self.down_s, default=0.0):.1f} s at most")
        fates = f"{len(self.acked)} acked, {len(self.refused)} refused, {len(lost)} lost, {twice} twice"
        executed = self.refused & self.came.keys()
        lines = {
            f"commands: {fates}": not lost and not twice,
            f"refused commands that were executed: {len(executed)}": not executed,
            f"robots' programs that ended: {self.ended} of {self.robots}": not self.ended,
            f"longest time of a viewer without a picture: {silent:.1f} s": silent <= MOST_GAP_S,
            f"memory of the first relay: {self.memory_mb[0]:.0f} MB, grew by {growth_mb:.0f}": growth_mb
            <= MOST_GROWTH_MB,
        }
        for line, holds in lines.items():
            print("PASS" if holds else "FAIL", line)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--robots", type=int, default=60)
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--stall", type=float, default=5.0, help="seconds for which NATS is stopped, every minute")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        soak = Soak(Path(folder), options.robots, options.viewers, options.stall)
        asyncio.run(soak.run(options.minutes))
    soak.report()


if __name__ == "__main__":
    main()

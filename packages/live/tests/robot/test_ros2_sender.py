"""The queue and the connection of the ament package bufgym_sender, compiled here without ROS, beside Python's own."""

import asyncio
import itertools
import json
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from xml.etree import ElementTree

import pytest
from live_cases import in_order, receiving
from loop_cases import until
from refusal_cases import refuse
from roscpp_cases import gone, run

from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.traces import Trace
from bufgym_live.robot import rclcpp, read_log, roscpp
from bufgym_live.robot.ros2.names import Published, parse
from bufgym_live.robot.shaped import ShapedLink

HEAD = Published("/camera", "sensor_msgs/msg/Image", False, False, 300, True, 5_000_000_000, 1, 2**40)
Process = asyncio.subprocess.Process


@pytest.fixture(scope="module")
def talker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program without ROS over the package's library, with three policies."""
    for needed in ("cmake", "g++"):
        if shutil.which(needed) is None:
            pytest.skip(f"no {needed} here")
    folder = tmp_path_factory.mktemp("ros2")
    source = rclcpp.write(folder / "source", roscpp.find("afr,drop-oldest,learned"))
    run("cmake", "-S", source, "-B", folder, "-DCMAKE_BUILD_TYPE=Debug", "-DCMAKE_DISABLE_FIND_PACKAGE_ament_cmake=ON")
    run("cmake", "--build", folder)
    program, own = folder / "talker", Path(__file__).with_name("ros2_talker.cpp")
    run("g++", "-std=c++17", "-I", source, own, "-o", program, folder / "libbufgym_queue.a", "-lpthread")
    return program


@asynccontextmanager
async def talking(talker: Path, *words: object) -> AsyncIterator[Process]:
    pipe = subprocess.PIPE
    process = await asyncio.create_subprocess_exec(talker, *map(str, words), stdin=pipe, stdout=pipe)
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


async def told(process: Process, command: str | None = None) -> dict[str, float]:
    """What the program says next: nothing once it has put all, its numbers at its end."""
    if command is not None:
        assert process.stdin is not None
        process.stdin.write(f"{command}\n".encode())
    assert process.stdout is not None
    line = await asyncio.wait_for(process.stdout.readline(), 60)
    return {} if line == b"put\n" else dict(json.loads(line))


@pytest.mark.parametrize("policy", ["afr", "learned"])
async def test_every_decision_is_the_simulators(policy: str, talker: Path, tmp_path: Path) -> None:
    """150 messages of 40 kB at 100 Hz, 32 Mbit/s, into a link of 8 Mbit/s: some 15 are dropped for 5 that go."""
    async with receiving() as (_, port, came):
        link = ShapedLink(Link(Trace.constant(1e6, duration_s=1)), ("127.0.0.1", port))
        try:
            async with talking(talker, "127.0.0.1", await link.listen(), policy, 5, tmp_path, 150, 40_000, 100) as one:
                assert await told(one) == {}
                numbers = await told(one, "end")
        finally:
            await link.close()
    assert in_order(came) and [one.seq for one in came] == gone(tmp_path / "camera-0.jsonl")
    assert all(parse(one.body) == (HEAD, b"b" * 40_000) for one in came)
    assert 15 < len(came) < 120
    counts = {"arrived": 150, "left": len(came), "dropped": 150 - len(came), "queued": 0, "faults": 0}
    h = qoi.exponential().information([one.x for one in came])
    assert numbers == {**counts, "qoi": pytest.approx(h)}


async def test_a_link_cut_and_back(talker: Path, tmp_path: Path) -> None:
    """What was on its way goes again under its number, and the queue holds the newest meanwhile."""
    async with receiving() as (_, port, came):
        link = ShapedLink(Link(Trace.constant(2e7, duration_s=1)), ("127.0.0.1", port))
        try:
            where = "127.0.0.1", await link.listen()
            async with talking(talker, *where, "drop-oldest", 4, tmp_path, 20, 5000, 100) as one:
                assert await told(one) == {}
                await until(lambda: came and came[-1].seq == 19)  # a late program puts in bursts, which drop
                link.cut()
                assert await told(one, "again") == {}
                link.mend()
                await until(lambda: came[-1].seq == 39)
                numbers = await told(one, "end")
        finally:
            await link.close()
    assert in_order(came)
    # The socket holds one message, and the system perhaps some that went before the cut was seen.
    assert [one.seq for one in came[-4:]] == [36, 37, 38, 39] and numbers["arrived"] == 40
    assert numbers["faults"] >= 1 and numbers["left"] == len(came) == 40 - numbers["dropped"]
    assert gone(tmp_path / "camera-0.jsonl") == [one.seq for one in came]


async def test_another_receiver_goes_on_where_the_first_was(talker: Path, tmp_path: Path) -> None:
    async with (
        receiving() as (_, port, first),
        receiving() as (_, other, second),
        talking(talker, "127.0.0.1", port, "drop-oldest", 64, tmp_path, 20, 100_000, 200) as one,
    ):
        assert await told(one) == {}
        await until(lambda: len(first) == 20)
        assert await told(one, f"move {other}") == {}
        numbers = await told(one, "end")
    assert {one.seq for one in first + second} == set(range(40)) and len(second) >= 20 and numbers["faults"] == 0
    assert [b.number - a.number for a, b in itertools.pairwise(second)] == [1] * (len(second) - 1)


async def test_no_receiver_costs_what_the_queue_drops(talker: Path, tmp_path: Path) -> None:
    async with receiving() as (receiver, port, _):
        await receiver.close()
        async with talking(talker, "127.0.0.1", port, "drop-oldest", 4, tmp_path, 30, 100, 1000) as one:
            assert await told(one) == {}
            records = read_log(tmp_path / "camera-0.jsonl")
    assert [r["seq"] for r in records if r["event"] == "dropped"] == list(range(1, 26))


def test_the_package_is_one_of_ros_2(tmp_path: Path) -> None:
    """Each parameter of the launch file is one that the node declares, and the version is bufgym's."""
    folder = rclcpp.write(tmp_path / "bufgym_sender", roscpp.find("afr"))
    package = ElementTree.parse(folder / "package.xml").getroot()
    assert package.findtext("name") == "bufgym_sender" and "@" not in str(package.findtext("version"))
    launch = ElementTree.parse(folder / "launch" / "sender.launch.xml").getroot()
    node = (folder / "node.cpp").read_text()
    given = {str(param.get("name")) for param in launch.iter("param")} - {"use_sim_time"}
    assert given and all(f'"{name}"' in node for name in given)
    refuse("policy codel: has no C", rclcpp.write, tmp_path, roscpp.find("codel"))

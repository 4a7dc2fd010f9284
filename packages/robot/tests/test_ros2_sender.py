"""The queue and the connection of the ament package bufgym_sender, compiled here without ROS, beside Python's own."""

import asyncio
import itertools
import json
import shutil
import subprocess
import sysconfig
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import pytest
from live_cases import in_order, receiving
from loop_cases import until
from needs import needs
from refusal_cases import refuse
from roscpp_cases import gone, run

from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.traces import Trace
from bufgym_robot import rclcpp, read_log, roscpp
from bufgym_robot.ros2.names import Published, parse
from bufgym_robot.shaped import ShapedLink

HEAD = Published("/camera", "sensor_msgs/msg/Image", False, False, 300, True, 5_000_000_000, 1, 2**40)
POLICIES: Final = "afr,drop-oldest,learned"
Process = asyncio.subprocess.Process
HERE: Final = Path(__file__).parent
MESSAGES: Final = Path(sysconfig.get_path("data"), "include")
"""C++ of ROS 2's messages, from the wheels that rclpy needs."""
DOUBLED: Final = (
    *("rclcpp/rclcpp.hpp", "rclcpp/create_generic_subscription.hpp", "rclcpp/detail/qos_parameters.hpp"),
    "rclcpp/version.h",
    *("rclcpp_components/register_node_macro.hpp", "rclcpp_lifecycle/lifecycle_node.hpp"),
)
OFFERED: Final = (
    "offer /robot/camera sensor_msgs/msg/Image camera best_effort 300",
    "offer /scan_a sensor_msgs/msg/LaserScan scanner reliable 3",
    "offer /scan_b sensor_msgs/msg/LaserScan bufgym_receive reliable 3",
    "offer /tf tf2_msgs/msg/TFMessage robot reliable 100",
)


@pytest.fixture(scope="module")
def talker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program without ROS over the package's library, with three policies."""
    for needed in ("cmake", "g++"):
        if shutil.which(needed) is None:
            pytest.skip(needs("compiler", needed))
    return built_with(tmp_path_factory.mktemp("ros2"), POLICIES)


def built_with(folder: Path, policies: str) -> Path:
    """Build the library with these policies and the program there."""
    source = rclcpp.write(folder / "source", roscpp.find(policies))
    run("cmake", "-S", source, "-B", folder, "-DCMAKE_BUILD_TYPE=Debug", "-DCMAKE_DISABLE_FIND_PACKAGE_ament_cmake=ON")
    run("cmake", "--build", folder)
    program, own = folder / "talker", HERE / "ros2_talker.cpp"
    run("g++", "-std=c++17", "-I", source, own, "-o", program, folder / "libbufgym_queue.a", "-lpthread")
    return program


@pytest.fixture(scope="module", params=["", pytest.param("-fsanitize=address,undefined", marks=pytest.mark.nightly)])
def node(request: pytest.FixtureRequest, talker: Path) -> Path:
    """The node itself over a double of rclcpp, and what drives it; nightly with each access to memory checked."""
    if not (MESSAGES / "nav_msgs").is_dir():
        pytest.skip(needs("rclcpp", f"no C++ of ROS 2's messages in {MESSAGES}"))
    folder, source = talker.parent / f"node{request.param}", talker.parent / "source"
    for name in DOUBLED:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text('#include "rclcpp_lifecycle_double.hpp"\n')
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-I", source, "-I", folder, "-I", HERE]
    flags += [word for package in sorted(MESSAGES.iterdir()) for word in ("-isystem", package)]
    given = [HERE / "ros2_node_session.cpp", source / "node.cpp", talker.parent / "libbufgym_queue.a"]
    if request.param:
        given = [request.param, *(source / f"{name}.cpp" for name in ("sender", "connection", "path")), *given]
    run("g++", *flags, *given, "-o", folder / "session", "-lpthread")
    return folder / "session"


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


async def reply(process: Process, command: str | None = None) -> dict[str, float]:
    """What the program says next: nothing once it has put all, its numbers at its end."""
    if command is not None:
        assert process.stdin is not None
        process.stdin.write(f"{command}\n".encode())
    assert process.stdout is not None
    line = await asyncio.wait_for(process.stdout.readline(), 60)
    return {} if line == b"put\n" else dict(json.loads(line))


async def said(process: Process, command: str) -> Any:
    """What the node's program answers."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(f"{command}\n".encode())
    return json.loads(await asyncio.wait_for(process.stdout.readline(), 60))


async def made(process: Process, *parameters: str) -> int:
    """Make the node beside some publishers; its state: 1 unconfigured, 2 inactive, 3 active, 4 finalized."""
    for offer in OFFERED:
        await said(process, offer)
    return int(await said(process, f"make /robot {' '.join(parameters)}"))


@pytest.mark.parametrize("policy", ["afr", "learned"])
async def test_every_decision_is_the_simulators(policy: str, talker: Path, tmp_path: Path) -> None:
    """150 messages of 40 kB at 100 Hz, 32 Mbit/s, into a link of 8 Mbit/s: some 15 are dropped for 5 that go."""
    async with receiving() as (_, port, came):
        link = ShapedLink(Link(Trace.constant(1e6, duration_s=1)), ("127.0.0.1", port))
        try:
            async with talking(talker, "127.0.0.1", await link.listen(), policy, 5, tmp_path, 150, 40_000, 100) as one:
                assert await reply(one) == {}
                numbers = await reply(one, "end")
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
                assert await reply(one) == {}
                await until(lambda: came and came[-1].seq == 19)  # a late program puts in bursts, which drop
                link.cut()
                assert await reply(one, "again") == {}
                link.mend()
                await until(lambda: came[-1].seq == 39)
                numbers = await reply(one, "end")
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
        assert await reply(one) == {}
        await until(lambda: len(first) == 20)
        assert await reply(one, f"move {other}") == {}
        numbers = await reply(one, "end")
    assert {one.seq for one in first + second} == set(range(40)) and len(second) >= 20 and numbers["faults"] == 0
    assert [b.number - a.number for a, b in itertools.pairwise(second)] == [1] * (len(second) - 1)


async def test_no_receiver_costs_what_the_queue_drops(talker: Path, tmp_path: Path) -> None:
    async with receiving() as (receiver, port, _):
        await receiver.close()
        async with talking(talker, "127.0.0.1", port, "drop-oldest", 4, tmp_path, 30, 100, 1000) as one:
            assert await reply(one) == {}
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
    refuse("policy rosbridge: has no C", rclcpp.write, tmp_path, roscpp.find("rosbridge"))


async def test_the_nodes_life(node: Path, tmp_path: Path) -> None:
    """200 messages of 40 kB at 200 Hz into a link of 8 Mbit/s; another receiver; a rest; its end."""
    async with receiving() as (_, port, came), receiving() as (_, other, second):
        link = ShapedLink(Link(Trace.constant(1e6, duration_s=1)), ("127.0.0.1", port))
        try:
            async with talking(node) as one:
                own = f"port={await link.listen()}", "autostart=false", "capacity=5", f"log={tmp_path}"
                depth = "qos_overrides./robot/camera.subscription.depth=7"
                assert await made(one, "topics=[camera,/scan*]", depth, *own) == 1
                assert [await said(one, to) for to in ("activate", "configure", "activate")] == [1, 2, 3]
                camera, scan = ["/robot/camera", HEAD.type, 7, 0], ["/scan_a", "sensor_msgs/msg/LaserScan", 5, 1]
                assert await said(one, "pass 0.2") == [[*camera, 1], [*scan, 1]]
                assert await said(one, "publish /robot/camera 200 40000 200") == 200
                for command in ("set policy afr", "set topics [/scan_a]", "set log /tmp"):
                    name = command.split()[1]
                    assert await said(one, command) == f"{name}: deactivate and clean up the node first"
                for command, part in (("capacity 65", "range"), ("port 0", "range"), ("autostart true", "read-only")):
                    assert part in await said(one, f"set {command}")
                numbers = await told_of_camera(one, 200)
                assert await said(one, f"set port {other}") == ""
                assert await said(one, "publish /robot/camera 1 50 100") == 1
                assert (await told_of_camera(one, 201))["left"] == numbers["left"] + 1
                assert await said(one, "deactivate") == 2
                assert await said(one, "pass 2") == [[*camera, 0], [*scan, 0]]
                assert await said(one, "publish /robot/camera 3 50 100") == 3  # an executor still held it
                assert await said(one, "activate") == 3
                assert await said(one, "pass 0.2") == [[*camera, 0], [*scan, 0], [*camera, 1], [*scan, 1]]
                assert await said(one, "publish /robot/camera 1 60 100") == 2
                await until(lambda: second and len(second[-1].body) == len(came[0].body) - 40_000 + 60)
                assert await said(one, "end") == 1
        finally:
            await link.close()
    assert in_order(came) and 5 < len(came) < 150
    assert parse(came[0].body)[0] == Published("/robot/camera", HEAD.type, False, False, 300)
    left = gone(tmp_path / "robot_camera-0.jsonl")
    assert left[: len(came)] == [one.seq for one in came] and left[-1] == 200
    h = qoi.exponential().information(left[:-1])
    counts = {"arrived": 200, "left": len(left) - 1, "dropped": 201 - len(left), "queued": 0, "oldest s": 0}
    assert {**numbers, **counts, "message": "connected", "QoI": pytest.approx(h, abs=1e-5)} == numbers
    assert [len(parse(message.body)[1]) for message in second[-2:]] == [50, 60]  # before them what was on its way


async def test_a_topic_that_a_receiver_publishes_beside_others_is_left_out(node: Path) -> None:
    """The node lets its subscription go while its own copies would come back, and then makes a new one."""
    async with talking(node) as one:
        assert await made(one, "topics=[camera]") == 1
        kept, let_go = (["/robot/camera", HEAD.type, 300, 0, held] for held in (1, 0))
        assert await said(one, "pass 0.4") == [kept]
        await said(one, f"offer /robot/camera {HEAD.type} bufgym_receive reliable 300")
        assert await said(one, "pass 0.4") == [let_go]
        await said(one, "gone /robot/camera bufgym_receive")
        assert await said(one, "pass 0.4") == [let_go, kept]
        assert await said(one, "end") == 1


async def test_wrong_parameters_are_one_line(node: Path) -> None:
    """The program prints it and ends with code 2; a container fails to load the node."""
    for given, why in (
        ("topics=/camera", "parameter topics"),
        ("port=0", "port"),
        ("capacity=65", "capacity"),
        ("policy=nonsense", f"policy nonsense: must be one of {POLICIES.replace(',', ', ')}"),
        ("value=cubic:2", "value cubic:2: must be exponential:BASE or saturating:DISTANCE"),
        ("log=/no/folder", "log /no/folder: must be a folder that can be written"),
    ):
        async with talking(node) as one:
            said_at_once = await said(one, f"make /robot {given if 'topics' in given else f'topics=[camera] {given}'}")
            assert isinstance(said_at_once, str) and why in said_at_once and said_at_once.isprintable()


async def told_of_camera(process: Process, arrived: int) -> dict[str, float]:
    """What /diagnostics tells of the camera once all of its messages have left or are dropped."""
    while True:
        await said(process, "pass 1")
        numbers = (await said(process, "diagnostics"))["/robot/bufgym_sender: /robot/camera"]
        if numbers["left"] + numbers["dropped"] == arrived:
            return dict(numbers)
        await asyncio.sleep(0.02)


async def test_a_node_that_starts_by_itself(node: Path, tmp_path: Path) -> None:
    """x is the robot's motion in scenes of 2 m; what cannot be configured waits until it is set right."""
    async with receiving() as (_, port, came):
        async with talking(node) as one:
            own = "autostart=false", f"port={port}", "odometry=odom", "value=cubic:2"
            assert await made(one, "topics=[camera]", *own) == 1
            assert await said(one, "configure") == 1
            assert await said(one, "set policy codel") == f"policy codel: must be one of {POLICIES.replace(',', ', ')}"
            assert [await said(one, f"set {right}") for right in ("value saturating:4", "odometry o'", "port 1")] == [
                ""
            ] * 3
            assert await said(one, "configure") == 1  # o' is no topic's name
            for right in ("odometry odom", f"port {port}", f"log {tmp_path}/none"):
                assert await said(one, f"set {right}") == ""
            assert await said(one, "configure") == 1  # no such folder
            assert await said(one, f"set log {tmp_path}") == ""
            assert [await said(one, to) for to in ("configure", "activate", "pass 0.2")][:2] == [2, 3]
            for metres in (0, 3, 5):
                await said(one, f"odometry /robot/odom {metres}")
                await said(one, "publish /robot/camera 1 10 100")
            await until(lambda: len(came) == 3)
            assert [await said(one, to) for to in ("shutdown", "end")] == [4, 1]
        async with talking(node) as one:
            assert await made(one, "topics=[camera]", f"port={port}") == 1
            assert len(await said(one, "pass 0.2")) == 1 and await said(one, "end") == 1
    assert [message.x for message in came] == [0, 1.5, 2.5]


async def test_latched_messages_come_whole_to_each_receiver(node: Path) -> None:
    """Of 12 drivers one says more, one starts again, and the receiver is another in the end; the queue holds one."""
    async with receiving() as (first, port, came), talking(node) as one:
        for k in range(12):
            await said(one, f"offer /tf_static tf2_msgs/msg/TFMessage driver_{k} latched 1")
        await said(one, f"make /robot topics=[/*] port={port} capacity=1")
        assert await said(one, "pass 0.4") == [["/tf_static", "tf2_msgs/msg/TFMessage", 1000, 1, 1]]
        for k in range(12):
            await said(one, f"publish /tf_static 1 {10 + k} 1000 driver_{k}")
        await until(lambda: len(came) == 12)
        assert [len(parse(message.body)[1]) for message in came] == list(range(10, 22))
        assert len({message.source for message in came}) == 12 and {message.at_us for message in came} == {5000}
        assert parse(came[0].body)[0].depth == 12 and parse(came[0].body)[0].latched
        await said(one, "publish /tf_static 1 50 1000 driver_3")
        await until(lambda: len(came) == 13)
        assert came[12].source == came[3].source
        await first.close()
        await said(one, "gone /tf_static driver_0")
        await said(one, "offer /tf_static tf2_msgs/msg/TFMessage driver_12 latched 1")
        await said(one, "publish /tf_static 1 60 1000 driver_12")
        await said(one, "pass 0.4")
        async with receiving(port) as (_, _, again):
            await until(lambda: len(again) == 12)
            sizes = [len(parse(message.body)[1]) for message in again]
            assert sizes == [11, 12, *range(14, 22), 50, 60]
            assert await said(one, "end") == 1

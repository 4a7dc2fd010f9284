"""roscpp's publishers under a policy, by LD_PRELOAD: real nodes in C++ on this machine, their decisions simulated."""

import contextlib
import os
import shutil
import signal
import socket
import struct
import subprocess
import time
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from refusal_cases import refuse

from bufgym_live.robot import read_log, replay, roscpp
from bufgym_live.robot.sockets import free_port

ROS_LIBRARIES = subprocess.run(["pkg-config", "--libs", "roscpp"], capture_output=True, text=True, check=False).stdout


def run(*words: Any) -> None:
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr + done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library with three policies, and a node that knows nothing of it."""
    for program in ("cmake", "g++", "rosmaster"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} here")
    if not ROS_LIBRARIES:
        pytest.skip("roscpp's headers (libroscpp-dev) are not here")
    folder = tmp_path_factory.mktemp("roscpp")
    roscpp.write(folder / "source", roscpp.find("afr,drop-oldest,learned"))
    run("cmake", "-S", folder / "source", "-B", folder, "-DCMAKE_BUILD_TYPE=Debug")
    run("cmake", "--build", folder)
    source = Path(__file__).with_name("roscpp_talker.cpp")
    run("g++", "-std=c++14", source, "-o", folder / "talker", *ROS_LIBRARIES.split(), "-lpthread")
    return folder


class Nodes:
    """Talkers beside a master of their own, and their output."""

    def __init__(self, built: Path, home: Path) -> None:
        self._built, port = built, free_port("127.0.0.1")
        uri = f"http://127.0.0.1:{port}"
        self._where = {**os.environ, "ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1", "ROS_HOME": str(home)}
        self._started: list[subprocess.Popen[str]] = []
        self._master: Any = xmlrpc.client.ServerProxy(uri)
        self._start("rosmaster", "--core", "-p", str(port))

    def _start(self, *words: str, **settings: str) -> "subprocess.Popen[str]":
        pipe = subprocess.PIPE
        environment = {**self._where, **settings}
        process = subprocess.Popen(words, env=environment, stdout=pipe, stderr=subprocess.STDOUT, text=True)
        self._started.append(process)
        return process

    def talker(self, topic: str, *words: Any, **settings: str) -> "subprocess.Popen[str]":
        """A node that publishes on the topic, once it is known to the master."""
        process = self._start(str(self._built / "talker"), topic, *map(str, words), **settings)
        while not self._nodes_of(topic):
            assert process.poll() is None
            time.sleep(0.05)
        return process

    def subscriber(self, topic: str) -> socket.socket:
        """A connection on which the topic's messages come, only as fast as they are read."""
        [name] = self._nodes_of(topic)
        with xmlrpc.client.ServerProxy(self._master.lookupNode("/test", name)[2]) as talker:
            _, host, port = talker.requestTopic("/test", f"/{topic}", [["TCPROS"]])[2]
        connection = socket.create_connection((host, port), timeout=5)
        fields = (f"callerid=/{port}", f"topic=/{topic}", "type=*", "md5sum=*", "tcp_nodelay=1")
        head = b"".join(struct.pack("<I", len(field)) + field.encode() for field in fields)
        connection.sendall(struct.pack("<I", len(head)) + head)
        block(connection)  # the talker's own fields
        return connection

    def _nodes_of(self, topic: str) -> list[str]:
        try:
            published = self._master.getSystemState("/test")[2][0]
        except OSError:
            return []
        return [node for name, nodes in published if name == f"/{topic}" for node in nodes]

    def close(self) -> None:
        self._master("close")()
        for process in reversed(self._started):
            process.kill()
            process.communicate()


def block(connection: socket.socket) -> bytes:
    """The next bytes that have their length before them."""
    return exactly(connection, struct.unpack("<I", exactly(connection, 4))[0])


def exactly(connection: socket.socket, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        more = connection.recv(min(count - len(data), 2**16))
        assert more, "the talker closed the connection"
        data += more
    return bytes(data)


def seqs(connection: socket.socket, most: int, pause_s: float = 0.0) -> list[int]:
    """The numbers of the images that come, with a pause before each, until there are so many or no more come."""
    came: list[int] = []
    with connection, contextlib.suppress(TimeoutError):
        while len(came) < most:
            time.sleep(pause_s)
            image = block(connection)
            came.append(int(image[16 : 16 + struct.unpack_from("<I", image, 12)[0]]))
    return came


@pytest.fixture
def nodes(built: Path, tmp_path: Path) -> Iterator[Nodes]:
    made = Nodes(built, tmp_path)
    yield made
    made.close()


def ended(process: "subprocess.Popen[str]") -> str:
    """What a node printed that ends well."""
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 0, text
    return text


def preload(built: Path, log: Path, **settings: str) -> dict[str, str]:
    log.mkdir(exist_ok=True)
    return {"LD_PRELOAD": str(built / "libbufgym_roscpp.so"), "BUFGYM_LOG": str(log), "BUFGYM_LOCAL": "1", **settings}


def logs(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.jsonl"))


def test_every_decision_is_the_simulators(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """A subscriber that reads slowly: 150 messages of 400 kB into a queue of 5; the log says what became of each."""
    log = tmp_path / "log"
    talker = nodes.talker("image", 5, 150, 400_000, 100, **preload(built, log, BUFGYM_POLICY="afr"))
    came = seqs(nodes.subscriber("image"), 150, pause_s=0.05)
    ended(talker)
    [file] = logs(log)
    records = read_log(file)
    assert came == [record["seq"] for record in records if record["event"] == "gone"]
    assert 15 < len(came) < 120 and came[-1] > 100
    again = replay(file)
    assert again.differences == () and again.outcome.delivered == len(came)


def test_each_subscriber_has_its_queue_and_each_topic_its_policy(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """One subscriber dies and another comes; the other topic keeps roscpp's own queue; SIGTERM loses no line."""
    log = tmp_path / "log"
    choice = preload(built, log, BUFGYM_TOPICS="/image=drop-oldest,/other=none", BUFGYM_POLICY="afr")
    talker = nodes.talker("image", 5, 10_000, 1000, 100, **choice)
    other = nodes.talker("other", 5, 10_000, 1000, 100, **choice)
    first, second, third = nodes.subscriber("image"), nodes.subscriber("image"), nodes.subscriber("other")
    assert len(seqs(first, 30)) == 30
    again = nodes.subscriber("image")
    assert len(seqs(second, 60)) == 60 and len(seqs(again, 30)) == 30 and len(seqs(third, 30)) == 30
    for process in (talker, other):
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30)
    assert [file.name for file in logs(log)] == ["image-0.jsonl", "image-1.jsonl", "image-2.jsonl"]
    for file in logs(log):
        records = read_log(file)
        assert (records[0]["policy"], records[0]["capacity"]) == ("drop-oldest", 5)
        assert replay(records).differences == ()


def test_a_latched_message_larger_than_the_sockets_buffer(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    nodes.talker("map", 1, 1, 20_000_000, 10, "latched", **preload(built, tmp_path / "log"))
    time.sleep(1)
    assert seqs(nodes.subscriber("map"), 1) == [0]
    assert seqs(nodes.subscriber("map"), 1) == [0]


def test_x_is_the_robots_motion(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """The talker goes 0.1 m before each message: 0.05 of a scene of 2 m."""
    log = tmp_path / "log"
    talker = nodes.talker("image", 5, 60, 1000, 30, "moves", **preload(built, log, BUFGYM_ODOMETRY="/odom"))
    assert len(seqs(nodes.subscriber("image"), 60)) == 60
    ended(talker)
    records = read_log(logs(log)[0])
    x = [record["x"] for record in records if record["event"] == "put"]
    steps = [(b - a) / 0.05 for a, b in zip(x, x[1:], strict=False)]
    assert x[-1] > 1.5 and all(step >= 0 and step == pytest.approx(round(step)) for step in steps)
    assert records[0]["v"]["numbers"] == [0, -1.0]


@pytest.mark.parametrize(
    "settings", [{"BUFGYM_LOCAL": "0"}, {"BUFGYM_POLICY": "none"}, {"BUFGYM_POLICY": "afrr"}], ids=str
)
def test_what_is_left_alone(settings: dict[str, str], built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """Subscribers on this machine, and topics without a policy; an unknown one says so."""
    talker = nodes.talker("image", 5, 30, 1000, 100, **preload(built, tmp_path / "log", **settings))
    assert len(seqs(nodes.subscriber("image"), 30)) == 30
    assert ("unknown policy afrr" in ended(talker)) == (settings.get("BUFGYM_POLICY") == "afrr")
    assert not logs(tmp_path / "log")


def test_a_policy_without_c_is_refused(tmp_path: Path) -> None:
    refuse("policy codel: has no C; known: afr", roscpp.write, tmp_path, roscpp.find("codel"))
    (tmp_path / "file").write_text("")
    refuse("file: File exists", roscpp.write, tmp_path / "file", [])

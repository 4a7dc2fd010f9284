"""roscpp's publishers under a policy, by LD_PRELOAD: real nodes in C++ on this machine, their decisions simulated."""

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import time
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from needs import needs
from refusal_cases import refuse
from roscpp_cases import block, build, gone, missing, publishers, seqs, subscriber

from bufgym_robot import read_log, roscpp
from bufgym_robot.wire.sockets import free_port

pytestmark = pytest.mark.timeout(600)  # the build takes seconds, and minutes beside other work


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the library with three policies, and of a node that knows nothing of it."""
    if reason := missing():
        pytest.skip(needs("roscpp", reason))
    return build(tmp_path_factory.mktemp("roscpp"), "afr,drop-oldest,learned").parent


@pytest.fixture(scope="module")
def master(built: Path) -> Iterator[int]:
    """The port of a master, one for all tests: each has topics of its own."""
    port = free_port("127.0.0.1")
    with subprocess.Popen(["rosmaster", "--core", "-p", str(port)], stdout=subprocess.DEVNULL) as process:
        while True:
            with contextlib.suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port)):
                break
            assert process.poll() is None
            time.sleep(0.05)
        yield port
        process.kill()


class Nodes:
    """Talkers beside a master, and subscribers of theirs."""

    def __init__(self, built: Path, port: int, home: Path) -> None:
        self._built, uri = built, f"http://127.0.0.1:{port}"
        self._where = {**os.environ, "ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1", "ROS_HOME": str(home)}
        self.started: list[subprocess.Popen[str]] = []
        self.master: Any = xmlrpc.client.ServerProxy(uri)

    def talker(self, topics: str, *words: Any, **settings: str) -> "subprocess.Popen[str]":
        """A node that publishes on the topics, once the last one is known to the master."""
        pipe, environment = subprocess.PIPE, {**self._where, **settings}
        command = [str(self._built / "talker"), topics, *map(str, words)]
        process = subprocess.Popen(command, env=environment, stdout=pipe, stderr=subprocess.STDOUT, text=True)
        self.started.append(process)
        while not publishers(self.master, topics.split(",")[-1]):
            assert process.poll() is None
            time.sleep(0.05)
        return process

    def subscriber(self, topic: str) -> socket.socket:
        return subscriber(self.master, topic)


@pytest.fixture
def nodes(built: Path, master: int, tmp_path: Path) -> Iterator[Nodes]:
    made = Nodes(built, master, tmp_path)
    yield made
    made.master("close")()
    for process in made.started:
        process.kill()
        process.communicate()


def has_published(process: "subprocess.Popen[str]") -> None:
    """Wait for the line that a talker prints after its last message."""
    assert process.stdout is not None
    assert any("published" in line for line in process.stdout)


def ended(process: "subprocess.Popen[str]") -> str:
    """What a node printed that ends well."""
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 0, text
    return text


def preload(built: Path, log: Path, **settings: str) -> dict[str, str]:
    """Settings of a node: the library, a log, local subscribers too, and these."""
    log.mkdir(exist_ok=True)
    variables = {f"BUFGYM_{name}": word for name, word in {"LOG": str(log), "LOCAL": "1", **settings}.items()}
    return {"LD_PRELOAD": str(built / "libbufgym_roscpp.so"), **variables}


def logs(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.jsonl"))


def test_every_decision_is_the_simulators(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """A subscriber that reads slowly: 150 messages of 400 kB into a queue of 5; the log says what became of each."""
    log = tmp_path / "log"
    talker = nodes.talker("slow", 5, 150, 400_000, 100, **preload(built, log, POLICY="afr"))
    came = seqs(nodes.subscriber("slow"), 150, pause_s=0.02)
    ended(talker)
    [file] = logs(log)
    assert came == gone(file)
    assert 15 < len(came) < 120 and came[-1] > 100


def test_each_of_two_subscribers_has_its_queue(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """One reads as they come, the other not before the last; 16 MB do not fit into the sockets between."""
    log = tmp_path / "log"
    talker = nodes.talker("pair", 5, 40, 400_000, 20, 2, **preload(built, log, POLICY="drop-oldest"))
    fast, slow = nodes.subscriber("pair"), nodes.subscriber("pair")
    as_they_come = seqs(fast, 40)
    has_published(talker)
    late = seqs(slow, 40)
    assert sorted([as_they_come, late]) == sorted(gone(file) for file in logs(log))
    assert len(late) < len(as_they_come) and late[-5:] == [35, 36, 37, 38, 39]


def test_a_subscriber_dies_and_returns_until_sigterm(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """The second one's queue is a new one, and at the node's sudden end the log has all that came, but for one line."""
    log = tmp_path / "log"
    talker = nodes.talker("again", 5, 10_000, 1000, 100, **preload(built, log))
    first = seqs(nodes.subscriber("again"), 10)
    assert len(first) == 10
    second = nodes.subscriber("again")
    block(second)
    talker.send_signal(signal.SIGTERM)
    rest = len(seqs(second, 10_000))
    talker.communicate(timeout=30)
    dead, returned = (gone(file) for file in logs(log))
    assert dead[:10] == list(range(10))
    assert returned == list(range(len(returned))) and 0 <= rest + 1 - len(returned) <= 1


def test_sixty_topics(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """A queue each: every message comes on every topic."""
    topics = [f"topic{k}" for k in range(60)]
    talker = nodes.talker(",".join(topics), 5, 5, 1000, 20, **preload(built, tmp_path / "log"))
    subscribers = [nodes.subscriber(topic) for topic in topics]
    assert [seqs(one, 5) for one in subscribers] == [[0, 1, 2, 3, 4]] * 60
    ended(talker)
    assert [gone(file) for file in logs(tmp_path / "log")] == [[0, 1, 2, 3, 4]] * 60


def test_a_latched_message_larger_than_the_sockets_buffer(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """Who comes after the last message gets it, and so does the next one."""
    has_published(nodes.talker("large_map", 1, 2, 20_000_000, 10, 0, **preload(built, tmp_path / "log")))
    assert seqs(nodes.subscriber("large_map"), 1) == [1]
    assert seqs(nodes.subscriber("large_map"), 1) == [1]


def test_x_is_the_robots_motion(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """The talker goes 0.1 m before each message, 0.05 of a scene. It writes a half as 0,5, and leaves no subscriber."""
    log = tmp_path / "log"
    (half := tmp_path / "half").write_text('LC_NUMERIC\ndecimal_point ","\nEND LC_NUMERIC\n')
    make = "localedef", "-ci", half, "-f", "ANSI_X3.4-1968", tmp_path / "comma"
    subprocess.run(make, capture_output=True, check=False)  # it warns of what is not defined
    place = {"LOCPATH": str(tmp_path), "LC_ALL": "comma"}
    talker = nodes.talker("moving", 5, 60, 1000, 30, 1, "moves", **place, **preload(built, log, ODOMETRY="/odom"))
    assert len(seqs(nodes.subscriber("moving"), 60)) == 60
    ended(talker)
    records = read_log(logs(log)[0])
    x = [record["x"] for record in records if record["event"] == "put"]
    steps = [(b - a) / 0.05 for a, b in itertools.pairwise(x)]
    assert "/odom" not in [topic for topic, _ in nodes.master.getSystemState("/test")[2][1]]
    assert x[-1] > 1.5 and all(step >= 0 and step == pytest.approx(round(step)) for step in steps)
    assert records[0]["v"]["numbers"] == [0, -1.0]


def test_small_and_unbounded_topics_are_left_alone(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """Nobody reads 60 images of 200 kB before the last: topics of roscpp's own lose their oldest, or none at all.

    So the newest five arrive on a bounded topic, as under "drop-oldest", and all on one without bounds.
    """
    log, topics = tmp_path / "log", ["image", "map", "tf", "clock"]
    settings = preload(built, log, TOPICS="/image=drop-oldest,/map=none")
    bounded = nodes.talker(",".join(topics), 5, 60, 200_000, 100, **settings)
    [node] = publishers(nodes.master, "image")
    unbounded = [nodes.talker(f"all_{-size}", size, 60, 200_000, 100, **settings) for size in (0, -1)]
    rosout, everything = subscriber(nodes.master, "rosout", node), [nodes.subscriber(f"all_{k}") for k in (0, 1)]
    subscribers = [nodes.subscriber(topic) for topic in topics]
    for talker in (bounded, *unbounded):
        has_published(talker)
    for came in (seqs(one, 60) for one in subscribers):
        assert len(came) < 60 and came[-5:] == [55, 56, 57, 58, 59]
    assert [seqs(one, 60) for one in everything] == [list(range(60))] * 2
    with rosout:
        assert b"published" in block(rosout)
    [file] = logs(log)
    assert (file.name, read_log(file)[0]["policy"]) == ("image-0.jsonl", "drop-oldest")


def test_parameters_are_numbers_too(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """roslaunch makes an int of "3". The log of an earlier run stays."""
    typed = {"bufgym_queue_size": 3, "bufgym_local": True, "bufgym_log": str(tmp_path)}
    nodes.master.setParam("/test", "/typed", typed)
    (tmp_path / "typed-0.jsonl").touch()
    talker = nodes.talker("typed", 5, 2, 1000, 100, "__name:=typed", LD_PRELOAD=preload(built, tmp_path)["LD_PRELOAD"])
    assert seqs(nodes.subscriber("typed"), 2) == [0, 1]
    ended(talker)
    assert [(file.name, read_log(file)[0]["capacity"]) for file in logs(tmp_path)[1:]] == [("typed-1.jsonl", 3)]


def test_no_message_waits_for_the_master(built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """Who sends holds a lock that roscpp takes second when it subscribes: a thread does it, for which an end waits."""
    words = {"TOPICS": "", "VALUE": "exponential:0.5", "QUEUE_SIZE": "5", "ODOMETRY": "/odom", "POLICY": "afr"}
    words["BACKOFF_S"] = "1"  # a setting without a variable is asked of the master
    talker = nodes.talker("alone", 5, 10_000, 1000, 100, "__name:=alone", **preload(built, tmp_path / "log", **words))
    found, pid = nodes.master.lookupNode("/test", "/alone"), nodes.master.getPid("/test")[2]
    os.kill(pid, signal.SIGSTOP)
    try:
        assert seqs(subscriber(SimpleNamespace(lookupNode=lambda *_: found), "alone", "/alone"), 10) == list(range(10))
        talker.send_signal(signal.SIGINT)
    finally:
        os.kill(pid, signal.SIGCONT)
    ended(talker)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"LOCAL": "yes"}, "BUFGYM_LOCAL = yes: must be 0 or 1"),
        ({"POLICY": "afrr"}, "unknown policy afrr: roscpp's own queue stays"),
        ({"QUEUE_SIZE": "65", "LOG": "/no/folder"}, "L = 65: must be 1 to 64|no log: /no/folder: No such file"),
        ({"ODOMETRY": "my odom", "LOG": ""}, "not valid in Graph Resource Name [my odom]"),
        ({"ODOMETRY": "/left", "LOG": ""}, "/left: must be a topic of nav_msgs/Odometry: x counts messages"),
    ],
)
def test_what_is_left_alone(settings: dict[str, str], said: str, built: Path, nodes: Nodes, tmp_path: Path) -> None:
    """Subscribers on this machine, and what a wrong setting is about, which is said."""
    talker = nodes.talker("left", 5, 10, 1000, 100, **preload(built, tmp_path / "log", **settings))
    assert seqs(nodes.subscriber("left"), 10) == list(range(10))
    text = ended(talker)
    assert all(words in text for words in said.split("|")) and not logs(tmp_path / "log")


def test_a_policy_without_c_is_refused(tmp_path: Path) -> None:
    refuse("policy rosbridge: has no C: its queue is unbounded", roscpp.write, tmp_path, roscpp.find("rosbridge"))
    refuse("policy codel: drops when the socket is free", roscpp.find, "codel")
    (tmp_path / "file").write_text("")
    refuse("file: File exists", roscpp.write, tmp_path / "file", [])

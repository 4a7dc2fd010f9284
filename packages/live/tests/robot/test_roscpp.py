"""roscpp's publishers under a policy, by LD_PRELOAD: real nodes in C++ on this machine, their decisions simulated."""

import itertools
import os
import signal
import socket
import subprocess
import time
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from refusal_cases import refuse
from roscpp_cases import build, missing, publishers, seqs, subscriber

from bufgym_live.robot import read_log, replay, roscpp
from bufgym_live.robot.sockets import free_port


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the library with three policies, and of a node that knows nothing of it."""
    if reason := missing():
        pytest.skip(reason)
    return build(tmp_path_factory.mktemp("roscpp"), "afr,drop-oldest,learned").parent


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
        while not publishers(self._master, topic):
            assert process.poll() is None
            time.sleep(0.05)
        return process

    def subscriber(self, topic: str) -> socket.socket:
        return subscriber(self._master, topic)

    def close(self) -> None:
        self._master("close")()
        for process in reversed(self._started):
            process.kill()
            process.communicate()


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
    steps = [(b - a) / 0.05 for a, b in itertools.pairwise(x)]
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

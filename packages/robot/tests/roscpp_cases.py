"""The library for roscpp, built; a node in C++; and a subscriber that reads as slowly as a test wants."""

import contextlib
import shutil
import socket
import struct
import subprocess
import time
import xmlrpc.client
from pathlib import Path
from typing import Any

from bufgym_robot import read_log, replay, roscpp


def missing() -> str:
    """What a build needs and is not here; empty if nothing is missing."""
    programs = [program for program in ("cmake", "g++", "pkg-config", "rosmaster") if shutil.which(program) is None]
    if programs or subprocess.run(["pkg-config", "--exists", "roscpp"], check=False).returncode:
        return f"no {programs[0] if programs else 'libroscpp-dev'} here"
    return ""


def build(folder: Path, policies: str, kind: str = "Debug") -> Path:
    """Build the library with these policies and the node ``talker``; the library's path."""
    roscpp.write(folder / "source", roscpp.find(policies))
    run("cmake", "-S", folder / "source", "-B", folder, f"-DCMAKE_BUILD_TYPE={kind}")
    run("cmake", "--build", folder)
    flags = run("pkg-config", "--libs", "roscpp").split()
    talker = Path(__file__).with_name("roscpp_talker.cpp")
    run("g++", "-std=c++14", talker, "-o", folder / "talker", *flags, "-lpthread")
    return folder / "libbufgym_roscpp.so"


def gone(file: Path) -> list[int]:
    """Numbers of the messages that left the socket, by a log in which the simulator decides the same."""
    records = read_log(file)
    again, left = replay(records), [record["seq"] for record in records if record["event"] == "gone"]
    assert again.differences == () and again.outcome.delivered == len(left)
    return left


def run(*words: Any) -> str:
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout


def publishers(master: Any, topic: str) -> list[str]:
    """The nodes that publish the topic; none where the master does not answer yet."""
    try:
        published = master.getSystemState("/test")[2][0]
    except OSError:
        return []
    return [node for name, nodes in published if name == f"/{topic}" for node in nodes]


def subscriber(master: Any, topic: str, node: str = "") -> socket.socket:
    """A connection on which the topic's messages come, only as fast as they are read; from the one node if unnamed."""
    if not node:
        [node] = publishers(master, topic)
    with xmlrpc.client.ServerProxy(master.lookupNode("/test", node)[2]) as talker:
        _, host, port = talker.requestTopic("/test", f"/{topic}", [["TCPROS"]])[2]  # type: ignore[index,misc]
    connection = socket.create_connection((str(host), int(str(port))), timeout=5)
    fields = (f"callerid=/{port}", f"topic=/{topic}", "type=*", "md5sum=*", "tcp_nodelay=1")
    head = b"".join(struct.pack("<I", len(field)) + field.encode() for field in fields)
    connection.sendall(struct.pack("<I", len(head)) + head)
    block(connection)  # the talker's own fields
    return connection


def block(connection: socket.socket) -> bytes:
    """The next bytes that have their length before them."""
    return exactly(connection, struct.unpack("<I", exactly(connection, 4))[0])


def exactly(connection: socket.socket, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        more = connection.recv(min(count - len(data), 2**16))
        if not more:
            raise EOFError
        data += more
    return bytes(data)


def seqs(connection: socket.socket, most: int, pause_s: float = 0.0, patience_s: float = 5.0) -> list[int]:
    """The numbers of the images that come, with a pause before each, until the last of so many or no more come."""
    came: list[int] = []
    connection.settimeout(patience_s)
    with connection, contextlib.suppress(TimeoutError, EOFError):
        while not came or came[-1] < most - 1:
            time.sleep(pause_s)
            image = block(connection)
            came.append(int(image[16 : 16 + struct.unpack_from("<I", image, 12)[0]]))
    return came

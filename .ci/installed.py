"""Does an installed bufgym work? An episode, a benchmark, errors. With ``--oldest FILE``: the oldest dependencies.

With ``--alone robot`` or ``relay`` that package is tried, and what came with it. Needs nothing but what it brings.
"""

import asyncio
import contextlib
import importlib.util
import io
import re
import sys
import tomllib
import urllib.request
from importlib import metadata


def oldest(pyproject: str) -> list[str]:
    """Each dependency of this Python at the lowest version that the file allows."""
    with open(pyproject, "rb") as file:
        dependencies = tomllib.load(file)["project"]["dependencies"]
    lowest = []
    for dependency in dependencies:
        match = re.fullmatch(r"([\w-]+)>=([\d.]+)[^;]*(?:; python_version(<|>=)'3\.(\d+)')?", dependency)
        if match is None:
            raise SystemExit(f"{pyproject}: no lowest version: {dependency}")
        name, version, relation, minor = match.groups()
        if relation is None or (sys.version_info.minor < int(minor)) == (relation == "<"):
            lowest.append(f"{name}=={version}")
    return lowest


def check() -> None:
    """Play an episode and compare two policies."""
    import gymnasium as gym

    import bufgym
    from bufgym.cli import main

    env = gym.make("bufgym/Uplink-v1", capacity=4, duration_s=5.0)
    _, info = env.reset(seed=0)
    ended = False
    while not ended:
        _, _, ended, _, info = env.step(env.action_space.sample(info["action_mask"]))
    assert info["arrived"] == info["delivered"] + info["dropped"] == 150, info
    assert main(["bench", "--policies", "learned,afr,drop-oldest", "--seconds", "5", "--seeds", "1"]) == 0
    assert main(["report", "nowhere"]) == 2
    places = {"live": "robot", "ros2": "robot", "robot": "robot", "relay": "robot relay", "reproduce": "papers"}
    for command, names in places.items():
        with contextlib.redirect_stderr(io.StringIO()) as errors:
            assert main([command]) == 2
        folders = " ".join(f"packages/{name}" for name in names.split())
        where = f"bufgym-{names.split()[-1]}: pip install {folders}, in bufgym's source tree"
        assert errors.getvalue() == f"bufgym: error: {command} comes with the package {where}\n", errors.getvalue()
    try:
        gym.make("bufgym/Mapping-v0")
        raise AssertionError("bufgym/Mapping-v0 was made")
    except bufgym.BufgymError as error:
        assert "comes with the package bufgym-papers: pip install packages/papers" in str(error), error
    print(f"bufgym {bufgym.__version__} on Python {sys.version.split()[0]}")


UNASKED = re.compile(r"ros-|rclpy|rospy|torch|numba|llvmlite|ziglang|cmake|ninja")
"""Beginnings of the names of what neither package brings: ROS, torch, compilers."""


def robot() -> None:
    """The robot's package holds no page, and its queue works."""
    from bufgym_robot import PolicyQueue

    assert importlib.util.find_spec("bufgym_relay") is None
    files = metadata.files("bufgym-robot") or []
    assert len(files) > 50 and not [file for file in files if file.suffix in (".html", ".js", ".css")]
    queue = PolicyQueue("drop-oldest", 2)
    for k in range(4):
        queue.put(k, 1000)
    queue.close()
    assert [item.message for item in queue] == [0, 2, 3]  # the socket took the first at once


async def relay() -> None:
    """A relay serves its page, and gives a viewer what a robot's client says."""
    from bufgym.model.topics import Topic
    from bufgym_relay import Config, Rule, Server
    from bufgym_robot import RobotClient, Session

    topic = "/robots/r/text"
    server = Server(Config(port=0, rules=(Rule(address="127.0.0.1", send=True, receive=True),)))
    await server.start()
    place = f"127.0.0.1:{server.port}"
    page = await asyncio.to_thread(lambda: urllib.request.urlopen(f"http://{place}/", timeout=60).read())
    assert b"<!doctype html>" in page.lower(), page[:100]
    came: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
    viewer = Session(f"ws://{place}", "desk", say=print)
    one = RobotClient(f"ws://{place}", "r", topics=(Topic(topic),), say=print)
    viewer.subscribe(f"^{topic}$", lambda message: came.done() or came.set_result(bytes(message.payload)))
    running = [asyncio.create_task(client.run()) for client in (viewer, one)]
    while not came.done():
        one.publish(topic, b'"here"')
        await asyncio.wait([came, *running], timeout=0.2, return_when=asyncio.FIRST_COMPLETED)
        assert not any(task.done() for task in running)
    assert came.result() == b'"here"'
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    await server.close()


def alone(package: str) -> None:
    """Try one package; what it needs came with it, and nothing else."""
    names = sorted(one.metadata["Name"].lower() for one in metadata.distributions())
    assert not [name for name in names if UNASKED.match(name)], names
    if package == "robot":
        robot()
    else:
        asyncio.run(asyncio.wait_for(relay(), 300))
    print(f"bufgym-{package} alone, with {len(names)} distributions")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--oldest"]:
        print("\n".join(oldest(sys.argv[2])))
    elif sys.argv[1:2] == ["--alone"]:
        alone(sys.argv[2])
    else:
        check()

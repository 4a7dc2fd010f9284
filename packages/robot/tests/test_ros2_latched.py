"""ROS 2: latched topics through the relay, where rclpy is; what the sender keeps of them everywhere."""

import asyncio
import json
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from loop_cases import beside, until
from test_ros2 import REPO, in_ros, run

from bufgym_robot.ros2 import relay
from bufgym_robot.ros2.names import Published
from bufgym_robot.ros2.relay import RosSender
from bufgym_robot.ros2.taking import Taken, source_of

MAP = Published("/map", "nav_msgs/msg/OccupancyGrid", transient_local=True, depth=1)
DEAD_S = 20
"""Time in which the receiver takes nothing."""


@in_ros
@pytest.mark.nightly
def test_late_viewers_have_all_state_after_a_restart_and_after_a_dead_link() -> None:
    """The state of 40 publishers, a map and a description beside a camera of 12 Mbit/s, under ``/*``, in a queue of 8.

    A late viewer gets each once: at first, after the receiver's death, after a link that was dead, after its end.
    """
    seen = json.loads(run(REPO / "packages/robot/tests/ros2_latched_session.py", DEAD_S).splitlines()[-1])
    eras = {"late": "first", "after a restart": "first", "after a dead link": "second", "after all": "third"}
    assert set(seen) == set(eras)
    for when, era in eras.items():
        came = seen[when]
        assert sorted(came["/tf_static"]) == sorted(f"{era} {k}" for k in range(40)), when
        assert [came[name] for name in ("/map", "/description")] == [[f"{era} /map"], [f"{era} /description"]], when


def test_a_log_is_no_state() -> None:
    """``/rosout`` is transient local, and its last line is not what it has to say."""
    assert MAP.latched and not replace(MAP, transient_local=False).latched and not replace(MAP, name="/rosout").latched


async def test_the_sender_forgets_publishers_that_are_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A map server starts again twice; two drivers of /tf_static stay beside a third that starts again."""
    batches: dict[str, list[list[Taken]]] = {
        "map": [[Taken(b"1", source_of(b"a"), 5_000)], [Taken(b"2", source_of(b"b"), 6_000)], [Taken(b"3", 3, 7_000)]],
        "tf": [[Taken(b"x", 1, 0), Taken(b"y", 2, 0), Taken(b"z", 4, 0)], [Taken(b"z", 5, 0)]],
    }
    living = {"/map": {3}, "/tf_static": {1, 2, 5}}

    def take_all(subscription: str) -> Iterator[Taken]:
        yield from batches[subscription].pop(0) if batches[subscription] else []

    monkeypatch.setattr(relay, "LOOK_S", 0.0)
    monkeypatch.setattr(relay, "take_all", take_all)
    monkeypatch.setattr(relay, "publishers", lambda node, name, but_not: living[name])
    monkeypatch.setattr(relay, "source_of", lambda gid: gid)
    robot = RosSender(None, "127.0.0.1", 1, topics=["/map", "/tf_static"])
    drivers = replace(MAP, name="/tf_static", depth=3)
    robot._taken = {"/map": (MAP, 0, "map"), "/tf_static": (drivers, 1, "tf")}
    async with beside(robot._take_latched(None)):
        await until(lambda: not any(batches.values()))
        await asyncio.sleep(0)
    assert robot.latched.sources(0) == [3] and sorted(robot.latched.sources(1)) == [1, 2, 5]
    newest = next(state for number in range(20) if (state := robot.latched.owed(number)) and state.source == 3)
    assert (newest.message, newest.at_us) == (MAP.head() + b"3", 7)


def test_a_message_over_the_limit_is_dropped_with_one_line_of_its_topic(monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is 1,000 bytes with a head; messages of other sizes and topics go on."""
    monkeypatch.setattr(relay, "MAX_BODY_BYTES", 1000)
    monkeypatch.setattr(relay.Hearing, "possible", lambda: False)  # nothing stands behind these subscriptions
    said: list[str] = []
    puts: list[Any] = []
    node = SimpleNamespace(create_subscription=lambda kind, name, put, qos, **rest: puts.append(put) or name)
    monkeypatch.setattr(Published, "serialized_class", None)
    monkeypatch.setattr(Published, "qos", None)
    monkeypatch.setattr(relay, "overriding", lambda: None)
    monkeypatch.setattr(relay, "of_subscription", lambda name, say: None)
    robot = RosSender(None, "127.0.0.1", 1, topics=["/image", "/scan"], policy="fifo", say=said.append)
    for place in robot._places:
        place.name = place.wanted
    for name in ("/image", "/scan"):
        robot._subscribe(node, Published(name, "a/msg/B"))
    most = 1000 - len(Published("/image", "a/msg/B").head())
    for put, size in ((puts[0], most), (puts[0], most + 1), (puts[0], most + 2), (puts[1], 10)):
        put(bytes(size))
    assert len(robot.queue) + robot.queue.in_flight == 2
    assert said[2:] == [f"/image: dropped: messages over {most} bytes, as one of {most + 1}"]

"""``bufgym robot``: a robot at a relay."""

import sys
from typing import Any, Literal

from bufgym.cli.options import Count, PolicyFile, one_policy
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library
from bufgym_robot import commands as live
from bufgym_robot.wire.options import SessionOptions


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


async def robot(
    *,
    session: SessionOptions = SessionOptions(),
    name: str = "robot-1",
    config: str | None = None,
    bag: str | None = None,
    ros: Literal["1", "2"] | None = None,
    odom: str | None = None,
    receive: list[str] | None = None,
    policies: str = "robofleet",
    policy_file: PolicyFile = None,
    capacity: Count = 32,
    window: live.Window = None,
) -> None:
    """Run a robot, recorded or of ROS; Ctrl-C ends it.

    Args:
        config: Its topics, as in examples/client.toml.
        bag: A recording as a robot, again and again.
        ros: The topics of this version of ROS, as in --config.
        odom: Topic that says where it is and gives x to the topics that move (default: its first Odometry; of tf:
            TOPIC:PARENT:CHILD).
        receive: With --ros: topics published here if they come.
        policies: The policy, as in bench.
        capacity: L, messages.
    """
    library("msgspec", "bufgym-robot[relay]", "bufgym robot")
    from bufgym.scenario import read_client
    from bufgym_robot.fleet.robot import Robot

    if bag is not None and ros is not None:
        raise BufgymError("--bag and --ros: give one of them")
    policy = one_policy(policies, policy_file)
    client = None if config is None else read_client(config)
    streams = None if client is None else client.streams
    settings: dict[str, Any] = {"window": window, "value": None if client is None else client.value}
    source: Any
    if bag is not None:
        from bufgym_robot.fleet.bag import BagSource

        source = BagSource(bag, streams)
    elif ros is not None:
        if streams is None:
            raise BufgymError("--ros needs --config: which topics, and the rules for each")
        from bufgym_robot.fleet.ros import SOURCES

        source = SOURCES[ros](streams, receive or [])
    else:
        raise BufgymError("needs --bag or --ros; examples/made_up_robot.py is a robot without either")
    settings |= session.settings()
    one = Robot(session.to, name, source, policy=policy, capacity=capacity, odometry=odom, say=say, **settings)
    live.say(f"{name} -> {session.to}; Ctrl-C ends it")
    await one.run()

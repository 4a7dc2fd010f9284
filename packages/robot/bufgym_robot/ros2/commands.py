"""``bufgym ros2``: a relay between two ROS 2 networks over one uplink that a policy rules."""

import contextlib
from collections.abc import Mapping
from typing import Annotated, Any

from cyclopts import Parameter

from bufgym.cli.options import Count, Least0, PolicyFile, one_policy
from bufgym.utils.errors import BufgymError
from bufgym_robot.commands import PORT, RECEIVER, Backoff, Host, Port, Transport, Window, address, listens_at, say
from bufgym_robot.wire.sockets import BACKOFF_S, host_port

RosArgs = Annotated[
    tuple[str, ...],
    Parameter(
        consume_multiple=True,
        allow_leading_hyphen=True,
        negative=(),
        help="ROS 2's own, to the end of the line: -r FROM:=TO, -r __ns:=/robot, -p NAME:=VALUE.",
    ),
]


async def send(
    *,
    config: str | None = None,
    to: str = RECEIVER,
    policies: str | None = None,
    policy_file: PolicyFile = None,
    capacity: Count = 32,
    odom: str | None = None,
    transport: Transport = "tcp",
    window: Window = None,
    backoff: Backoff = BACKOFF_S,
    log: str | None = None,
    ros_args: RosArgs = (),
) -> None:
    """On the robot: subscribe, and send over one uplink; Ctrl-C ends it.

    Parameters of its node are `topics` (names or patterns as /scan*), `policy`, `value`, `capacity`, `odometry`, `host`
    and `port`; they come before options, and `qos_overrides./TOPIC.subscription.depth` and the like before all.

    Args:
        config: Topics with rates and priorities, as in examples/client.toml.
        to: HOST:PORT of the receiver.
        policies: The policy, as in bench (default: afr; for several topics gap-priority).
        capacity: L, messages.
        odom: Topic with poses, which give x to the topics that move.
        log: Log every decision to this file (.mcap), for live replay.
    """
    from bufgym.model import qoi
    from bufgym.scenario import read_client
    from bufgym_robot import LogFile
    from bufgym_robot.ros2.relay import SENDER, RosSender, own_node
    from bufgym_robot.wire.row import refuse_rivals

    client = None if config is None else read_client(config)
    if policies is not None:
        refuse_rivals(one_policy(policies, policy_file))
    host, port = address(to)
    with contextlib.ExitStack() as stack:
        node = stack.enter_context(own_node(SENDER, ros_args))
        options = {"policy": policies or "", "value": "", "capacity": capacity, "odometry": odom or ""}
        parameters = _parameters(node, {"topics": [""], **options, "host": host, "port": port})
        robot = RosSender(
            client,
            *address(host_port(parameters["host"], parameters["port"])),
            topics=[name for name in parameters["topics"] if name],
            policy=one_policy(parameters["policy"], policy_file) if parameters["policy"] else None,
            capacity=parameters["capacity"],
            value=qoi.load(parameters["value"]) if parameters["value"] else None,
            odometry=parameters["odometry"] or None,
            transport=transport,
            window=window,
            backoff_s=backoff,
            log=None if log is None else stack.enter_context(LogFile(log)),
            say=say,
        )
        await robot.run(node)


_ABOUT = {
    "topics": "Names, or patterns with * and ?, besides the topics in --config",
    "policy": "Drops messages when the queue is full; empty: afr for one topic, gap-priority for several",
    "value": "V of topics without one, as exponential:0.618 or saturating:4",
    "capacity": "L, messages of all topics together",
    "odometry": "Topic with poses, which gives x to the topics that move",
    "host": "Where bufgym ros2 receive listens",
    "port": "Its port",
}
"""The node's parameters."""


def _parameters(node: Any, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Declare the node's parameters; return what the user set them to."""
    from rcl_interfaces.msg import ParameterDescriptor
    from rclpy.exceptions import ParameterException

    parameters = {}
    for name, default in defaults.items():
        try:
            about = ParameterDescriptor(description=_ABOUT[name], read_only=True)
            parameters[name] = node.declare_parameter(name, default, about).value
        except ParameterException as error:
            raise BufgymError(f"parameter {name}: {error}") from None
    return parameters


async def receive(
    at: str | None = None,
    /,
    *,
    port: Port = PORT,
    host: Host = "127.0.0.1",
    transport: Transport = "tcp",
    hold: Least0 = 10.0,
    ros_args: RosArgs = (),
) -> None:
    """At the other end: receive and republish; Ctrl-C ends it.

    Args:
        at: HOST:PORT to listen on, in place of --host and --port.
        hold: From the start a topic's messages wait for a reader, and the sender with them, so many seconds at most.
    """
    from bufgym_robot.ros2 import relay

    host, port = listens_at(at, host, port)
    await relay.receive(port, host, transport, say, ros_args, hold)

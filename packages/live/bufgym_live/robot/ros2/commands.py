"""``bufgym ros2``: a relay between two ROS 2 networks over one uplink that a policy rules."""

import contextlib

from bufgym.cli.options import Count, PolicyFile, one_policy
from bufgym_live.robot.commands import PORT, RECEIVER, Host, Port, Transport, Window, address, listens_at, say
from bufgym_live.robot.decided_in import Compiled, decide_in_python


async def send(
    *,
    config: str,
    to: str = RECEIVER,
    policies: str | None = None,
    policy_file: PolicyFile = None,
    capacity: Count = 32,
    odom: str | None = None,
    transport: Transport = "tcp",
    window: Window = None,
    compiled: Compiled = False,
    log: str | None = None,
) -> None:
    """On the robot: subscribe, and send over one uplink; Ctrl-C ends it.

    Args:
        config: Topics, as in examples/client.toml.
        to: HOST:PORT of the receiver.
        policies: The policy, as in bench (default: afr; for several topics learned-scheduler).
        capacity: L, messages.
        odom: Topic with poses, which give x to the topics that move.
        log: Log every decision to this file (.mcap), for live replay.
    """
    decide_in_python(unless=compiled)
    from bufgym.scenario import read_client
    from bufgym_live.robot import LogFile
    from bufgym_live.robot.ros2.relay import RosSender

    client = read_client(config)
    policy = one_policy(policies or ("afr" if len(client.streams) == 1 else "learned-scheduler"), policy_file)
    host, port = address(to)
    with contextlib.ExitStack() as stack:
        file = None if log is None else stack.enter_context(LogFile(log))
        robot = RosSender(
            client,
            host,
            port,
            policy=policy,
            capacity=capacity,
            odometry=odom,
            transport=transport,
            window=window,
            log=file,
            say=say,
        )
        await robot.run()


async def receive(
    at: str | None = None, /, *, port: Port = PORT, host: Host = "127.0.0.1", transport: Transport = "tcp"
) -> None:
    """At the other end: receive and republish; Ctrl-C ends it.

    Args:
        at: HOST:PORT to listen on, in place of --host and --port.
    """
    decide_in_python()
    from bufgym_live.robot.ros2 import relay

    host, port = listens_at(at, host, port)
    await relay.receive(port, host, transport, say)

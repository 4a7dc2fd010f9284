"""``bufgym ros2``: a relay between two ROS 2 networks over one uplink that a policy rules."""

from __future__ import annotations

import argparse

from bufgym.cli.live import PORT, TRANSPORTS, address, run_async
from bufgym.cli.options import Commands, command, count, load_policies, loaded, natural, policy_file

CAPACITY = 32


def add(commands: Commands) -> None:
    ros2 = commands.add_parser("ros2", help="a relay between ROS 2 networks, its uplink under a policy")
    parts = ros2.add_subparsers(title="commands", metavar="COMMAND", required=True)
    send = command(parts, "send", _send, "on the robot: subscribe, and send over one uplink; Ctrl-C ends it")
    send.add_argument("--config", required=True, metavar="FILE.toml", help="topics, as in examples/client.toml")
    send.add_argument("--to", default=f"127.0.0.1:{PORT}", metavar="HOST:PORT", help="the receiver (%(default)s)")
    send.add_argument(
        "--policies", metavar="NAME", help="the policy, as in bench (afr; for several topics learned-scheduler)"
    )
    policy_file(send)
    send.add_argument("--capacity", type=count, default=CAPACITY, metavar="L", help="L, messages (%(default)s)")
    send.add_argument("--odom", metavar="TOPIC", help="poses, which give x to the topics that move")
    send.add_argument("--transport", choices=TRANSPORTS, default="tcp", help="(%(default)s)")
    send.add_argument("--log", metavar="LOG.mcap", help="log every decision there, for live replay")

    receive = command(parts, "receive", _receive, "at the other end: receive and republish; Ctrl-C ends it")
    receive.add_argument("--port", type=natural, default=PORT, help="(%(default)s)")
    receive.add_argument("--host", default="127.0.0.1", help="address to listen on (%(default)s: this machine alone)")
    receive.add_argument("--transport", choices=TRANSPORTS, default="tcp", help="(%(default)s)")


def _say(text: str) -> None:
    print(text, flush=True)


def _send(options: argparse.Namespace) -> None:
    import contextlib

    from bufgym.robot import LogFile
    from bufgym.robot.ros2.relay import RosSender
    from bufgym.scenario import read_client

    client = read_client(options.config)
    load_policies(options.policy_file)
    default = "afr" if len(client.streams) == 1 else "learned-scheduler"
    (policy,) = loaded([options.policies or default])[0]
    host, port = address(options.to)
    with contextlib.ExitStack() as stack:
        log = None if options.log is None else stack.enter_context(LogFile(options.log))
        robot = RosSender(
            client,
            host,
            port,
            policy=policy,
            capacity=options.capacity,
            odometry=options.odom,
            transport=options.transport,
            log=log,
            say=_say,
        )
        run_async(robot.run())


def _receive(options: argparse.Namespace) -> None:
    from bufgym.robot.ros2.relay import receive

    run_async(receive(options.port, options.host, options.transport, _say))

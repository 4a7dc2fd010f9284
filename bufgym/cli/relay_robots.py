"""``bufgym relay robot`` and ``bufgym relay foxglove``: robots and a viewer for a relay."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from bufgym.cli.live import run_async
from bufgym.cli.options import Commands, command, count, load_policies, loaded, natural, policy_file
from bufgym.ground.errors import BufgymError

CAPACITY = 32


def add(parts: Commands) -> None:
    robot = command(parts, "robot", _robot, "a robot, recorded or of ROS; Ctrl-C ends it")
    _add_session(robot)
    robot.add_argument("--name", default="robot-1", help="(%(default)s)")
    robot.add_argument("--config", metavar="FILE.toml", help="its topics, as in examples/client.toml")
    kinds = robot.add_mutually_exclusive_group()
    kinds.add_argument("--bag", metavar="FILE", help="a recording as a robot, again and again")
    kinds.add_argument("--ros", choices=("1", "2"), help="the topics of this version of ROS, as in --config")
    robot.add_argument("--odom", metavar="TOPIC", help="with --ros: poses, which give x to the topics that move")
    robot.add_argument(
        "--receive", nargs="+", default=[], metavar="TOPIC", help="with --ros: published here if it comes"
    )
    robot.add_argument("--policies", metavar="NAME", help="the policy, as in bench (robofleet)")
    policy_file(robot)
    robot.add_argument("--capacity", type=count, default=CAPACITY, metavar="L", help="L, messages (%(default)s)")

    foxglove = command(parts, "foxglove", _foxglove, "a viewer that Foxglove and Lichtblick connect to; Ctrl-C ends it")
    _add_session(foxglove)
    foxglove.add_argument("--name", default="foxglove", help="(%(default)s)")
    foxglove.add_argument("--port", type=natural, default=8765, help="where they connect to (%(default)s)")
    foxglove.add_argument("--topics", default="^/", metavar="REGEX", help="topics to show (%(default)s)")


def _add_session(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--to", default="ws://127.0.0.1:7420", metavar="URL", help="the relay (%(default)s)")
    parser.add_argument("--token-file", metavar="FILE", help="who this is (default: $BUFGYM_RELAY_TOKEN)")
    parser.add_argument("--ca", metavar="FILE.pem", help="with wss: who signs the relay's certificate")
    parser.add_argument("--certificate", metavar="FILE.pem", help="with wss: this one's own, with its key")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _robot(options: argparse.Namespace) -> None:
    from bufgym.relay.robot import Robot
    from bufgym.relay.session import security, token
    from bufgym.scenario import read_client

    load_policies(options.policy_file)
    (policy,) = loaded([options.policies or "robofleet"])[0]
    client = None if options.config is None else read_client(options.config)
    settings: dict[str, Any] = {} if client is None else {"window": client.window, "value": client.value}

    async def run() -> None:
        robot = Robot(
            options.to,
            options.name,
            _source(options, None if client is None else client.streams),
            policy=policy,
            capacity=options.capacity,
            token=token(options.token_file),
            tls=security(options.ca, options.certificate),
            say=_say,
            **settings,
        )
        print(f"{options.name} -> {options.to}; Ctrl-C ends it", flush=True)
        await robot.run()

    run_async(run())


def _source(options: argparse.Namespace, streams: Any) -> Any:
    if options.bag is not None:
        from bufgym.relay.bag import BagSource

        return BagSource(options.bag, streams)
    if options.ros is not None:
        if streams is None:
            raise BufgymError("--ros needs --config: which topics, and the rules for each")
        from bufgym.relay import ros

        return ros.SOURCES[options.ros](streams, options.odom, options.receive)
    raise BufgymError("needs --bag or --ros; examples/made_up_robot.py is a robot without either")


def _foxglove(options: argparse.Namespace) -> None:
    async def show() -> None:
        from bufgym.relay.session import security, token

        settings = {"token": token(options.token_file), "tls": security(options.ca, options.certificate)}
        await _bridge(options.to, options.name, options.port, options.topics, **settings).run()

    run_async(show())


def _bridge(url: str, name: str, port: int, topics: str = "^/", **session: Any) -> Any:
    from bufgym.relay.foxglove import Bridge
    from bufgym.relay.session import Session

    bridge = Bridge(Session(url, name, say=_say, **session), port, pattern=topics)
    print(f"ws://{bridge.address}: Foxglove, Lichtblick -> {url}; Ctrl-C ends it", flush=True)
    return bridge

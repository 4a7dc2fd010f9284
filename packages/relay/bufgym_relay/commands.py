"""``bufgym relay``: a fleet's server, its robots, and a viewer."""

import sys
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter

from bufgym.cli.options import Count, PolicyFile, PortNumber, one_policy
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library
from bufgym_robot import commands as live


@Parameter(name="*", group=Group.create_ordered("The relay"))
@dataclass(frozen=True)
class SessionOptions:
    to: str = "ws://127.0.0.1:7420"
    """URL of the relay; others behind commas stand in while it is away."""
    token_file: str | None = None
    """Who this is (default: $BUFGYM_RELAY_TOKEN)."""
    ca: str | None = None
    """With wss: file (.pem) of who signs the relay's certificate."""
    certificate: str | None = None
    """With wss: file (.pem) of this one's own, with its key."""

    def settings(self) -> dict[str, Any]:
        from bufgym_relay.address import security, token

        token(self.token_file)  # a file that cannot be read ends the start
        return {"token": partial(token, self.token_file), "tls": security(self.ca, self.certificate)}


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _needs_the_extra() -> None:
    library("msgspec", "bufgym-live[relay]", "bufgym relay")


async def serve(*, config: str, check: bool = False) -> None:
    """Run the server under a configuration; Ctrl-C ends it, SIGHUP rereads rules, keys and certificate.

    Args:
        config: As examples/relay.toml.
        check: Only read it and print its permissions.
    """
    _needs_the_extra()
    from bufgym_relay import config as configurations
    from bufgym_relay import policies, server

    settings = configurations.load(config)
    if check:
        for name in settings.policies:
            policies.policy(name)  # raises an error if there is none
        print(f"{config}: {len(settings.rules)} rules, {settings.host}:{settings.port}")
        return
    await server.serve_forever(settings, live.say, partial(configurations.load, config))


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
    _needs_the_extra()
    from bufgym.scenario import read_client
    from bufgym_relay.robot import Robot

    if bag is not None and ros is not None:
        raise BufgymError("--bag and --ros: give one of them")
    policy = one_policy(policies, policy_file)
    client = None if config is None else read_client(config)
    streams = None if client is None else client.streams
    settings: dict[str, Any] = {"window": window, "value": None if client is None else client.value}
    source: Any
    if bag is not None:
        from bufgym_relay.bag import BagSource

        source = BagSource(bag, streams)
    elif ros is not None:
        if streams is None:
            raise BufgymError("--ros needs --config: which topics, and the rules for each")
        from bufgym_relay.ros import SOURCES

        source = SOURCES[ros](streams, receive or [])
    else:
        raise BufgymError("needs --bag or --ros; examples/made_up_robot.py is a robot without either")
    settings |= session.settings()
    one = Robot(session.to, name, source, policy=policy, capacity=capacity, odometry=odom, say=say, **settings)
    live.say(f"{name} -> {session.to}; Ctrl-C ends it")
    await one.run()


async def foxglove(
    *,
    session: SessionOptions = SessionOptions(),
    name: str = "foxglove",
    port: Annotated[PortNumber, Parameter(help="Where they connect to.")] = 8765,
    topics: str = "^/",
    origins: list[str] | None = None,
) -> None:
    """Run a viewer that Foxglove and Lichtblick connect to; Ctrl-C ends it.

    Args:
        topics: Topics to show, a regular expression.
        origins: Other web pages that may connect, as https://lichtblick.example.org.
    """
    _needs_the_extra()
    from bufgym_relay.foxglove import Bridge
    from bufgym_relay.session import Session

    viewer = Session(session.to, name, say=say, **session.settings())
    bridge = Bridge(viewer, port, pattern=topics, origins=origins or ())
    live.say(f"ws://{bridge.address}: Foxglove, Lichtblick -> {session.to}; Ctrl-C ends it")
    await bridge.run()

"""A relay for fleets: robots and viewers connect to it, and publish and subscribe by topic as its rules allow.

Robofleet [sikand2021robofleet] is a client on each robot, one server and a web page. This package is the server, built
on bufgym's queues. ``Server`` serves what a ``Config`` allows. ``RobotClient``, ``Session`` and ``Robot`` connect to
it, and ``wire`` defines the protocol on its WebSockets.
"""

from typing import TYPE_CHECKING, Any

from bufgym.utils.libraries import needs
from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym_relay.address import security, token
    from bufgym_relay.bag import BagSource
    from bufgym_relay.client import RobotClient
    from bufgym_relay.config import Config, Foxglove, Limits, Nats, Rotation, Rule, StoreLimits, Tls, Tokens, load
    from bufgym_relay.policies import compiled
    from bufgym_relay.robot import Robot, Source
    from bufgym_relay.server import Server, serve_forever
    from bufgym_relay.session import Session
    from bufgym_relay.wire import Message, RefusedError

__all__ = [
    "BagSource", "Config", "Foxglove", "Limits", "Message", "Nats", "RefusedError", "Robot", "RobotClient", "Rotation",
    "Rule", "Server", "Session", "Source", "StoreLimits", "Tls", "Tokens", "compiled", "load", "security",
    "serve_forever", "token",
]  # fmt: skip
_on_demand = on_demand(__name__, {
    "BagSource": "bag", "RobotClient": "client", "Config": "config", "Foxglove": "config", "Limits": "config",
    "Nats": "config", "Rotation": "config", "Rule": "config", "StoreLimits": "config", "Tls": "config",
    "Tokens": "config", "load": "config", "compiled": "policies", "Robot": "robot", "Source": "robot",
    "Server": "server", "serve_forever": "server", "Session": "session", "security": "address", "token": "address",
    "Message": "wire", "RefusedError": "wire"
})  # fmt: skip


def __getattr__(name: str) -> Any:
    with needs("msgspec", "bufgym-live[relay]", "bufgym_relay"):  # the other libraries of the extra come with it
        return _on_demand(name)

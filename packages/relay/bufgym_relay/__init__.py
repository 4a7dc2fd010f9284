"""A relay for fleets: robots and viewers connect to it, and publish and subscribe by topic as its rules allow.

Robofleet [sikand2021robofleet] is a client on each robot, one server and a web page. This package is the server, built
on bufgym's queues, and the page. ``Server`` serves what a ``Config`` allows. Robots and viewers are clients of
``bufgym_robot``, whose ``wire`` is all that both packages share.
"""

from typing import TYPE_CHECKING

from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym_relay.config import Config, Foxglove, Limits, Nats, Rotation, Rule, StoreLimits, Tls, Tokens, load
    from bufgym_relay.policies import compiled
    from bufgym_relay.server import Server, serve_forever

__version__ = "0.2.0"
__all__ = [
    "Config", "Foxglove", "Limits", "Nats", "Rotation", "Rule", "Server", "StoreLimits", "Tls", "Tokens", "compiled",
    "load", "serve_forever",
]  # fmt: skip
__getattr__ = on_demand(__name__, {
    "Config": "config", "Foxglove": "config", "Limits": "config", "Nats": "config", "Rotation": "config",
    "Rule": "config", "StoreLimits": "config", "Tls": "config", "Tokens": "config", "load": "config",
    "compiled": "policies", "Server": "server", "serve_forever": "server"
})  # fmt: skip

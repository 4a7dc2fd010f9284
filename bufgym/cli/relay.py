"""``bufgym relay``: a fleet's server, and its robots."""

from __future__ import annotations

import argparse
from typing import Any

from bufgym.cli import relay_robots
from bufgym.cli.live import run_async
from bufgym.cli.options import Commands, command


def add(commands: Commands) -> None:
    relay = commands.add_parser("relay", help="a server for fleets: robots and viewers meet there")
    parts = relay.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_server(parts)
    relay_robots.add(parts)


# --- the server ------------------------------------------------------------------------------------------------------


def _add_server(parts: Any) -> None:
    serve = command(parts, "serve", _serve, "the server, with what a configuration allows; Ctrl-C ends it")
    serve.add_argument("--config", required=True, metavar="FILE.toml", help="as examples/relay.toml")
    serve.add_argument("--check", action="store_true", help="only read it and print its permissions")


def _serve(options: argparse.Namespace) -> None:
    from bufgym.relay import config
    from bufgym.robot.extra import needs

    settings = config.load(options.config)
    with needs("websockets"):
        from bufgym.relay import policies, server
    if options.check:
        policies.check(settings.policies)
        print(f"{options.config}: {len(settings.rules)} rules, {settings.host}:{settings.port}")
        return
    run_async(server.serve_forever(settings, _say))


def _say(text: str) -> None:
    print(text, flush=True)

"""The commands that this package adds to ``bufgym``: (purpose, commands below it)."""

from typing import Any

RELAY: Any = (
    "A server for fleets: robots and viewers meet there.",
    {name: f"bufgym_relay.commands:{name}" for name in ("serve", "foxglove")},
)

"""The commands that this package adds to ``bufgym``: where each function is, or (purpose, commands below it)."""

from typing import Any

_ROBOT, _RELAY = "bufgym_robot", "bufgym_relay.commands"

LIVE: Any = (
    "Policies on real sockets, beside the simulator.",
    {
        "send": f"{_ROBOT}.commands:send",
        "receive": f"{_ROBOT}.commands:receive",
        "link": f"{_ROBOT}.commands:link",
        "validate": f"{_ROBOT}.checks:validate",
        "view": f"{_ROBOT}.checks:view",
        "replay": f"{_ROBOT}.checks:replay",
        "cost": f"{_ROBOT}.cost:cost",
    },
)
ROS2: Any = (
    "A relay between ROS 2 networks, its uplink under a policy.",
    {"send": f"{_ROBOT}.ros2.commands:send", "receive": f"{_ROBOT}.ros2.commands:receive"},
)
RELAY: Any = (
    "A server for fleets: robots and viewers meet there.",
    {name: f"{_RELAY}:{name}" for name in ("serve", "robot", "foxglove")},
)
EXPORT = f"{_ROBOT}.export:export"

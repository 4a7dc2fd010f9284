"""The commands that this package adds to ``bufgym``: where each function is, or (purpose, commands below it)."""

from typing import Any

_HERE = "bufgym_robot"

LIVE: Any = (
    "Policies on real sockets, beside the simulator.",
    {
        "send": f"{_HERE}.commands:send",
        "receive": f"{_HERE}.commands:receive",
        "link": f"{_HERE}.commands:link",
        "validate": f"{_HERE}.checks:validate",
        "view": f"{_HERE}.checks:view",
        "replay": f"{_HERE}.checks:replay",
        "cost": f"{_HERE}.cost:cost",
    },
)
ROS2: Any = (
    "A relay between ROS 2 networks, its uplink under a policy.",
    {"send": f"{_HERE}.ros2.commands:send", "receive": f"{_HERE}.ros2.commands:receive"},
)
ROBOT = f"{_HERE}.fleet.commands:robot"
EXPORT = f"{_HERE}.export:export"

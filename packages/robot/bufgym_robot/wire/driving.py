"""Messages that drive a robot.

A message on ``/robots/NAME/drive`` is JSON, ``{"linear": 0.3, "angular": -0.2, "for_ms": 400}``: m/s ahead, rad/s to
the left, and its deadline.
"""

import json
import math
from typing import Final, NamedTuple

from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.messages import Message

TOPIC: Final = "drive"
MOST_MS: Final = 1_000
"""Longest deadline that a message may have."""


class Velocity(NamedTuple):
    """Velocity in the plane: m/s ahead, rad/s to the left."""

    linear: float
    angular: float


STILL: Final = Velocity(0.0, 0.0)


def read(message: Message) -> tuple[Velocity, float]:
    """Return a message's velocity and deadline in s."""
    try:
        match json.loads(bytes(message.payload)):
            case {"linear": float() | int() as linear, "angular": float() | int() as angular, "for_ms": int() as ms}:
                if math.isfinite(linear) and math.isfinite(angular) and 0 <= ms <= MOST_MS:
                    return Velocity(float(linear), float(angular)), ms / 1e3
    except (ValueError, OverflowError):
        pass
    rule = f"must be JSON with the finite numbers linear and angular, and for_ms from 0 to {MOST_MS}"
    raise BufgymError(f"topic {message.topic}: {bytes(message.payload[:60])!r}: {rule}")

"""Robofleet's server rule for a receiver with bytes pending, as a policy."""

from typing import Final

from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.relay.config import SKIP_PENDING


def skip_pending(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Skip the receiver: queue nothing."""
    return REJECT if buffer.busy else ACCEPT


POLICY: Final = Policy(
    SKIP_PENDING, skip_pending, source="Robofleet's server (ut-amrl/robofleet_server)", compile=True, built_in=True
)

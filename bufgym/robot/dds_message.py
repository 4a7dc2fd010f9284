"""Message type for DDS; the library reads the annotations at import, so they can't be strings."""

from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import key
from cyclonedds.idl.types import sequence, uint8
from cyclonedds.util import duration


@dataclass
class Message(IdlStruct, typename="bufgym.Message"):  # type: ignore[misc, call-arg]
    """A frame, to or from the sender of this name."""

    name: str
    key("name")
    data: sequence[uint8]


_RELIABLE = Policy.Reliability.Reliable(duration(seconds=20))
QUALITY: dict[str, Any] = {
    "up": Qos(_RELIABLE, Policy.History.KeepAll),
    # The sender may discover the receiver late, so answers are kept for it.
    "down": Qos(_RELIABLE, Policy.History.KeepLast(1024), Policy.Durability.TransientLocal),
}

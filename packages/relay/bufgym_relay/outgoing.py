"""A message on its way to its receivers."""

from dataclasses import dataclass, field
from typing import Final

from websockets.frames import Frame, Opcode

from bufgym_robot.wire import messages as wire

ROBOFLEET: Final = "robofleet"
"""Encoding of Robofleet's flatbuffers, and the only form in which its clients get messages."""


@dataclass(eq=False)
class Outgoing:
    """An outgoing message; its WebSocket frame in each form is made once for all receivers."""

    message: wire.Message
    _frames: dict[str, bytes] = field(init=False, default_factory=dict)

    def frame(self, form: str) -> bytes:
        """Give the whole frame in the form that a client asked for."""
        if form not in self._frames:
            if form == "json":
                whole = Frame(Opcode.TEXT, wire.to_json(self.message).encode())
            elif form == ROBOFLEET:
                whole = Frame(Opcode.BINARY, bytes(self.message.payload))
            else:
                whole = Frame(Opcode.BINARY, wire.encode(self.message))
            self._frames[form] = whole.serialize(mask=False)
        return self._frames[form]

    @property
    def size_bytes(self) -> int:
        return wire.HEADER_BYTES + len(self.message.payload)

"""Options of every command that connects to a relay."""

from dataclasses import dataclass
from functools import partial
from typing import Any

from cyclopts import Group, Parameter


@Parameter(name="*", group=Group.create_ordered("The relay"))
@dataclass(frozen=True)
class SessionOptions:
    to: str = "ws://127.0.0.1:7420"
    """URL of the relay; others behind commas stand in while it is away."""
    token_file: str | None = None
    """Who this is (default: $BUFGYM_RELAY_TOKEN)."""
    ca: str | None = None
    """With wss: file (.pem) of who signs the relay's certificate."""
    certificate: str | None = None
    """With wss: file (.pem) of this one's own, with its key."""

    def settings(self) -> dict[str, Any]:
        from bufgym_robot.wire.address import security, token

        token(self.token_file)  # a file that cannot be read ends the start
        return {"token": partial(token, self.token_file), "tls": security(self.ca, self.certificate)}

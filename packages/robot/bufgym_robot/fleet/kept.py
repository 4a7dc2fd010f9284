"""A robot's stops in a file of its own, so that a stop holds over the robot's restarts."""

import hashlib
import json
import os
import re
import secrets
from pathlib import Path
from typing import Final

from bufgym_robot.wire.ledger import Ledger, Stop, read

_MOST_BYTES: Final = 2**20


def place(relay: str, name: str) -> Path:
    """Give the file of a robot at a relay, ``HOST:PORT``: in $XDG_STATE_HOME/bufgym, or ~/.local/state/bufgym."""
    folder = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "bufgym"
    mark = hashlib.blake2b(f"{name}\n{relay}".encode(), digest_size=8).hexdigest()
    return folder / f"stops-{re.sub('[^A-Za-z0-9._-]', '-', name)[:40]}-{mark}.json"


class Kept:
    """The file; ``fault`` says why it could not be read or written at the last try, ``is_behind`` that it must be."""

    def __init__(self, path: Path) -> None:
        self.path, self.fault, self.is_behind = path, "", False

    def load(self) -> Ledger:
        """Read the stops. Of a file that cannot be read nobody knows whether one holds: so the robot is stopped."""
        try:
            with self.path.open("rb") as file:
                said = json.loads(file.read(_MOST_BYTES))
            if not isinstance(said, dict) or not isinstance(said.get("stops"), list):
                raise ValueError('must be an object with a list "stops"')
            stops = list(read(said["stops"]))
            if len(stops) < len(said["stops"]):
                raise ValueError("one of its stops is none")
            return Ledger(stops)
        except FileNotFoundError:
            return Ledger()
        except (OSError, ValueError, RecursionError) as error:
            # A who of its own: the release of an earlier damage is not one of this.
            stopped = Ledger([Stop(f"file-{secrets.token_hex(8)}", 1, "its damaged file of stops", 1)])
            self.save(stopped.as_json())  # so that it is the same one after a restart
            self.fault = f"{self.path}: {error}: which stops hold is not known, so it is stopped"
            return stopped

    def save(self, stops: list[dict[str, object]]) -> None:
        """Write the stops; a power failure leaves the old file or the new one."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            new = self.path.with_suffix(".new")
            with new.open("w") as file:
                json.dump({"stops": stops}, file)
                file.flush()
                os.fsync(file.fileno())
            new.replace(self.path)
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
            self.fault, self.is_behind = "", False
        except OSError as error:
            self.is_behind = True
            self.fault = f"{self.path}: {error.strerror or error}: its stops are forgotten when it restarts"

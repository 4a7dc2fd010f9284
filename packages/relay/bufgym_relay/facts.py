"""What a relay knows of its robots beside the messages held for them: who was here, and their stops."""

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from bufgym_robot.wire.ledger import Stop, read


class Writer(Protocol):
    """The file that the facts are in."""

    def transaction(self, synced: bool = False) -> AbstractContextManager[None]:
        """Commit what the block writes."""

    def bearable(self) -> AbstractContextManager[None]:
        """Log that it cannot be written, and go on."""

    def note(self, why: str) -> None:
        """Log a fault."""


class Facts:
    """Tables of the store's file. After the start, all methods run in the thread of its disk."""

    def __init__(self, db: sqlite3.Connection, held: Writer) -> None:
        self._db, self._held = db, held

    def stops(self) -> Iterator[tuple[str, Stop]]:
        """Read all robots' stops; a file that cannot be read ends the start."""
        for robot, said in self._db.execute("SELECT robot, said FROM stop").fetchall():
            for stop in read([json.loads(said)]):
                yield robot, stop

    def keep_stops(self, robot: str, stops: Sequence[Stop]) -> None:
        """Write a robot's stops in place of those before, so that a power failure does not undo it.

        Raises RefusedError: the disk cannot be written.
        """
        rows = [(robot, stop.who, json.dumps(stop.as_json())) for stop in stops]
        with self._held.transaction(synced=True):
            self._db.execute("DELETE FROM stop WHERE robot = ?", (robot,))
            self._db.executemany("INSERT INTO stop VALUES (?, ?, ?)", rows)

    def robots(self) -> list[tuple[str, int, str]]:
        """Read the robots that were here, as ``Store.robots``; none if they cannot be read."""
        try:
            return self._db.execute("SELECT name, seen_us, said FROM robot").fetchall()
        except sqlite3.Error as error:
            self._held.note(f"the robots cannot be read: {error}")
            return []

    def keep_robots(self, rows: Sequence[tuple[str, int, str]], most: int) -> None:
        """Write these, and keep of all only the ``most`` that were here last."""
        with self._held.bearable(), self._held.transaction():
            self._db.executemany("INSERT OR REPLACE INTO robot VALUES (?, ?, ?)", rows)
            last = "SELECT name FROM robot ORDER BY seen_us DESC LIMIT ?"
            self._db.execute(f"DELETE FROM robot WHERE name NOT IN ({last})", (most,))

    def forget_robot(self, name: str) -> None:
        """Remove a robot."""
        with self._held.bearable(), self._held.transaction():
            self._db.execute("DELETE FROM robot WHERE name = ?", (name,))

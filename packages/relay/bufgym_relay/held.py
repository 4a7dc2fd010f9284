"""No_drop messages on disk and the sessions that they are held for, in SQLite.

A message, its number to each receiver and the number of its sender are committed together.
"""

import math
import os
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Final

from bufgym.utils.errors import BufgymError
from bufgym_relay.audit import Audit
from bufgym_relay.config import Config
from bufgym_relay.disk import Disk
from bufgym_relay.facts import Facts
from bufgym_relay.rules import Identity
from bufgym_relay.stored import Settled, StoredSession
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import UNKNOWN, RefusedError
from bufgym_robot.wire.orders import robot_of
from bufgym_robot.wire.patterns import Pattern, pattern

FILE: Final = "held.sqlite"
MOST: Final = 256
"""Settled messages of a session whose outcomes are remembered."""
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS session (
    id INTEGER PRIMARY KEY, name TEXT, address TEXT, email TEXT, temporary INTEGER, received INTEGER, numbered INTEGER,
    robot TEXT DEFAULT '');
CREATE TABLE IF NOT EXISTS durable (session INTEGER, id TEXT, pattern TEXT, PRIMARY KEY (session, id)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS message (
    id INTEGER PRIMARY KEY, sender INTEGER, seq INTEGER, topic TEXT, frame BLOB, receivers INTEGER,
    waiting INTEGER, lost INTEGER, until_us INTEGER DEFAULT 0, why TEXT DEFAULT '');
CREATE TABLE IF NOT EXISTS delivery (
    session INTEGER, number INTEGER, message INTEGER, PRIMARY KEY (session, number)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS outcome (
    session INTEGER, seq INTEGER, receivers INTEGER, lost INTEGER, why TEXT, PRIMARY KEY (session, seq)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS robot (name TEXT PRIMARY KEY, seen_us INTEGER, said TEXT) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS stop (robot TEXT, who TEXT, said TEXT, PRIMARY KEY (robot, who)) WITHOUT ROWID;
"""
_ADDED: Final = {
    "message": ("until_us INTEGER DEFAULT 0", "why TEXT DEFAULT ''"),
    "session": ("robot TEXT DEFAULT ''",),
}
"""Table -> columns that earlier files lack."""
_COLUMNS: Final = "id, name, address, email, temporary, received, numbered, robot"


def _opened(path: str) -> sqlite3.Connection:
    """Open a store, made new or of an earlier release; a sqlite3.Error if it is none, or damaged, or another's."""
    db = sqlite3.connect(path, timeout=0.5, isolation_level=None, check_same_thread=False)
    try:
        for pragma in ("locking_mode = EXCLUSIVE", "journal_mode = WAL"):
            db.execute(f"PRAGMA {pragma}")
        db.executescript(_SCHEMA)
        for table, columns in _ADDED.items():
            for column in columns:
                with suppress(sqlite3.OperationalError):  # it is there
                    db.execute(f"ALTER TABLE {table} ADD COLUMN {column}")
        db.execute(f"SELECT {_COLUMNS} FROM session LIMIT 0")
        (state,) = db.execute("PRAGMA quick_check(1)").fetchone()
        if state != "ok":
            raise sqlite3.DatabaseError(" ".join(state.split()))
    except sqlite3.Error:
        db.close()
        raise
    return db


class Held:
    """The file, or memory without a folder. After the start, all methods run in the thread of ``disk``.

    ``tell`` is called in the event loop with each message as soon as it is settled.
    """

    def __init__(self, config: Config, disk: Disk, audit: Audit, tell: Callable[[Settled], None]) -> None:
        self._limits, self._disk, self._audit, self._tell = config.store, disk, audit, tell
        path = ":memory:" if config.folder is None else str(config.folder / FILE)
        try:
            self._db = _opened(path)
        except sqlite3.Error as error:
            way = "a damaged one must be moved away, with what it holds, or be replaced by a backup"
            rule = f"must be a relay's own, of one relay at a time; {way}"
            raise BufgymError(f"{path}: {error}: {rule}") from None
        self._file = None if config.folder is None else (path, os.stat(path).st_ino)
        self.there = True
        """Whether the file was where a relay that starts anew looks for it, when it was last looked for."""
        self.fault = ""
        """Why the file could not be written at the last try; empty if it could."""
        self.bytes = 0
        self.facts = Facts(self._db, self)
        self._by_id: dict[int | None, StoredSession] = {}

    def load(self) -> Iterator[StoredSession]:
        """Read the sessions of the relay that ran before, and forget all that ended with it."""
        ended, found = list[StoredSession](), dict[tuple[str, str], StoredSession]()
        for row in self._db.execute(f"SELECT {_COLUMNS} FROM session ORDER BY id").fetchall():
            id, name, address, email, temporary, received, numbered, robot = row
            session = StoredSession(name, Identity(address, email), bool(temporary), received, numbered, id=id)
            session.kept, session.sent, session.robot = True, numbered, robot
            for one, text in self._db.execute("SELECT id, pattern FROM durable WHERE session = ?", (id,)):
                with suppress(BufgymError):  # an earlier release took more; its client is told when it subscribes again
                    session.durable[one] = pattern(text)
            held = "SELECT count(*), coalesce(sum(length(frame)), 0) FROM delivery JOIN message ON id = message"
            session.held, session.held_bytes = self._db.execute(f"{held} WHERE session = ?", (id,)).fetchone()
            outcomes = "SELECT seq, receivers, lost, why FROM outcome WHERE session = ?"
            session.outcomes = {row[0]: Settled(session, *row) for row in self._db.execute(outcomes, (id,))}
            self._by_id[id] = session
            if temporary:  # left by a relay that was killed
                ended.append(session)
            elif before := found.pop(session.key, None):  # it could not be forgotten
                ended.append(before)
            if not temporary:
                found[session.key] = session
        (self.bytes,) = self._db.execute("SELECT coalesce(sum(length(frame)), 0) FROM message").fetchone()
        for session in ended:
            self.forget(session)
        dated = "SELECT session, number, frame FROM delivery JOIN message ON id = message WHERE until_us > 0"
        for id, number, frame in self._db.execute(dated).fetchall():
            if wire.decode(frame, len(frame)).at_us > time.time() * 1e6:  # the clock went back: how old is it?
                self.deny(self._by_id[id], number, UNKNOWN)
        yield from found.values()

    def look(self) -> None:
        """Look whether the file is still there."""
        try:
            self.there = self._file is None or os.stat(self._file[0]).st_ino == self._file[1]
        except OSError:
            self.there = False

    def forget(self, session: StoredSession) -> bool:
        """Forget a session and its messages; return whether that could be written."""
        with self.bearable():
            if session.id is not None:
                gone = (f"DELETE FROM {table} WHERE session = ?" for table in ("durable", "outcome"))
                self._settle(session, 0, 2**62, 1, "DELETE FROM session WHERE id = ?", *gone)
                del self._by_id[session.id]
                session.id = None
        return session.id is None

    def remember(self, session: StoredSession, received: int = 0, numbered: int = 0) -> None:
        """Write a session as it is now, with numbers that are at least these."""
        session.received, session.numbered = max(session.received, received), max(session.numbered, numbered)
        if session.kept:
            with self.bearable():
                self._save(session)

    def want(self, session: StoredSession, id: str, pattern: Pattern) -> None:
        """Note that matching messages are held while the session is away."""
        if session.id is None:
            self._save(session)
        with self.transaction(synced=True):
            self._db.execute("INSERT OR REPLACE INTO durable VALUES (?, ?, ?)", (session.id, id, pattern.text))
        session.durable[id] = pattern

    def want_no_more(self, session: StoredSession, id: str) -> None:
        """End that."""
        with self.bearable(), self.transaction():
            self._db.execute("DELETE FROM durable WHERE session = ? AND id = ?", (session.id, id))

    def hold(
        self,
        sender: StoredSession,
        seq: int,
        topic: str,
        frame: bytes,
        receivers: Sequence[StoredSession],
        until_us: int,
    ) -> bool:
        """Write a message; return whether it is new, not taken meanwhile over another connection."""
        if seq == sender.received:
            return False
        if receivers:
            self.make_room(len(frame), receivers)
        for session in (sender, *receivers):
            if session.id is None:
                self._save(session)
        with self.transaction(synced=True):
            if receivers:
                row = sender.id, seq, topic, frame, len(receivers), len(receivers), until_us
                columns = (
                    "(sender, seq, topic, frame, receivers, waiting, lost, until_us) VALUES (?, ?, ?, ?, ?, ?, 0, ?)"
                )
                message = self._db.execute(f"INSERT INTO message {columns}", row).lastrowid
            for receiver in receivers:
                number = receiver.numbered + 1
                self._db.execute("INSERT INTO delivery VALUES (?, ?, ?)", (receiver.id, number, message))
                self._db.execute("UPDATE session SET numbered = ? WHERE id = ?", (number, receiver.id))
            self._db.execute("UPDATE session SET received = ? WHERE id = ?", (seq, sender.id))
        sender.received = seq
        # Only after the commit: what is rolled back must not count.
        self.bytes += len(frame) if receivers else 0
        for receiver in receivers:
            receiver.numbered += 1
            receiver.held += 1
            receiver.held_bytes += len(frame)
        return True

    def make_room(self, size_bytes: int, receivers: Sequence[StoredSession]) -> None:
        """Let the oldest go: of a full session, and of the identity with the most bytes, so that others get theirs.

        Raises RefusedError: nobody but these has to wait; or the message is larger than the store.
        """
        full = [each for each in receivers if each.held >= self._limits.messages]
        if len(full) == len(receivers):
            raise RefusedError("store_full", f"session {full[0].name} has not acked {self._limits.messages} messages")
        for each in full:
            self._let_go(each)
        while self.bytes + size_bytes > self._limits.bytes:
            shares: Counter[str] = Counter()
            for session in self._by_id.values():
                shares[session.identity.key] += session.held_bytes
            holders = list(self._by_id.values()) or receivers
            largest = max(holders, key=lambda one: (shares[one.identity.key], one.held_bytes))
            alone = all(each.identity.key == largest.identity.key for each in receivers)
            if alone or size_bytes > self._limits.bytes:
                raise RefusedError("store_full", f"no room for {size_bytes} bytes beside {self.bytes}")
            self._let_go(largest)

    def _let_go(self, session: StoredSession) -> None:
        (oldest,) = self._db.execute("SELECT min(number) FROM delivery WHERE session = ?", (session.id,)).fetchone()
        who = {"session": session.name, "identity": session.identity.key}
        self._disk.on_loop(self._audit.repeated, what="held", code="store_full", **who)
        self._settle(session, oldest, oldest, 1)

    def next(self, session: StoredSession, after: int) -> tuple[int, str, bytes]:
        """Find number, topic and frame of the session's next message; with no frame, none is left up to the number."""
        query = (
            "SELECT number, topic, frame FROM delivery JOIN message ON message.id = delivery.message "
            "WHERE session = ? AND number > ? ORDER BY number LIMIT 1"
        )
        found: tuple[int, str, bytes] | None = self._db.execute(query, (session.id, after)).fetchone()
        return found or (session.numbered, "", b"")

    def settle_acked(self, session: StoredSession) -> None:
        """End the deliveries that the session has acked; if that cannot be written, a later ack does it."""
        session.settling, acked = False, session.acked  # read once: the event loop moves it on
        with self.bearable():
            self._settle(session, 0, acked, 0)
            session.settled = max(session.settled, acked)
            for number in [one for one in list(session.answers) if one <= acked]:
                session.answers.pop(number, None)

    def deny(self, session: StoredSession, number: int, why: str) -> None:
        """Drop the message of this number, which the session must not have any more; ``why`` is its answer."""
        session.answers[number] = why
        with self.bearable():
            self._settle(session, number, number, 1)
        session.answers.pop(number, None)

    def expire(self, now_us: int, why: str) -> None:
        """Drop the messages whose deadline is over and that no connection is about to ack."""
        late = "SELECT session, number FROM delivery JOIN message ON id = message WHERE until_us BETWEEN 1 AND ?"
        for id, number in self._db.execute(late, (now_us,)).fetchall():
            session = self._by_id.get(id)
            if session is not None and session.away_s < math.inf:
                self.deny(session, number, session.why_not(number, why))

    def waits(self, sender: StoredSession, seq: int) -> bool:
        """Whether a message of this sender is still held."""
        query = "SELECT 1 FROM message WHERE sender = ? AND seq = ?"
        return self._db.execute(query, (sender.id, seq)).fetchone() is not None

    def note(self, why: str) -> None:
        """Log a fault."""
        self._audit.repeated(what="store", code="store_full", why=why)

    def close(self) -> None:
        """Close the file; everything is on disk already."""
        self._db.close()

    @contextmanager
    def transaction(self, synced: bool = False) -> Iterator[None]:
        """Commit what the block writes; if ``synced``, a power failure does not undo it, nor what was committed before.

        Raises RefusedError: the disk cannot be written; then nothing has changed.
        """
        self.look()
        if not self.there:
            raise RefusedError("store_full", "the store cannot be written: its file was deleted")
        try:
            # What an ack promises is synced. Other changes may be undone: a client's numbers make good for each.
            self._db.execute(f"PRAGMA synchronous = {'FULL' if synced else 'NORMAL'}")
            self._db.execute("BEGIN IMMEDIATE")
            yield
            self._db.execute("COMMIT")
            self.fault = ""
        except BaseException as error:
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            if isinstance(error, sqlite3.Error):
                self.fault = f"the store cannot be written: {error}"
                raise RefusedError("store_full", self.fault) from None
            raise

    @contextmanager
    def bearable(self) -> Iterator[None]:
        """Log that the store cannot be written, and go on."""
        try:
            yield
        except RefusedError as refused:
            self._disk.on_loop(self._audit.repeated, what="store", code=refused.code, why=str(refused))

    def _settle(self, session: StoredSession, first: int, last: int, lost: int, *also: str) -> None:
        """End deliveries to a session; ``also`` are statements about its id for the same transaction."""
        settled, sizes, freed_bytes = [], [], 0
        chosen = "FROM delivery WHERE session = ? AND number BETWEEN ? AND ?"
        with self.transaction():
            rows = self._db.execute(f"SELECT message, number {chosen}", (session.id, first, last)).fetchall()
            self._db.execute(f"DELETE {chosen}", (session.id, first, last))
            for statement in also:
                self._db.execute(statement, (session.id,))
            for id, number in rows:
                (sender, seq, receivers, waiting, gone, size_bytes, why, topic) = self._db.execute(
                    "UPDATE message SET waiting = waiting - 1, lost = lost + ?, why = coalesce(nullif(?, ''), why) "
                    "WHERE id = ? RETURNING sender, seq, receivers, waiting, lost, length(frame), why, topic",
                    (lost, session.answers.get(number, ""), id),
                ).fetchone()
                why = why or (UNKNOWN if gone and robot_of(topic) else "")
                sizes.append(size_bytes)
                if waiting == 0:
                    self._db.execute("DELETE FROM message WHERE id = ?", (id,))
                    freed_bytes += size_bytes
                    if sender in self._by_id:
                        self._db.execute("DELETE FROM outcome WHERE session = ? AND seq <= ?", (sender, seq - MOST))
                        row = sender, seq, receivers, gone, why
                        self._db.execute("INSERT OR REPLACE INTO outcome VALUES (?, ?, ?, ?, ?)", row)
                        settled.append(Settled(self._by_id[sender], seq, receivers, gone, why))
        # After the commit, too; and only then are senders told.
        session.held -= len(sizes)
        session.held_bytes -= sum(sizes)
        self.bytes -= freed_bytes
        for message in settled:
            self._disk.on_loop(self._tell, message)

    def _save(self, session: StoredSession) -> None:
        """Write the session; a new one gets its id in a transaction of its own, so that the id is never rolled back."""
        who = session.identity
        numbers = session.received, session.numbered, session.robot
        row = session.id, session.name, who.address, who.email, session.temporary, *numbers
        with self.transaction():
            insert = f"INSERT OR REPLACE INTO session ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)"
            id = self._db.execute(insert, row).lastrowid
        session.id = id
        self._by_id[id] = session

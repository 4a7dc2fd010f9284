"""The store's file over a backup and an upgrade, by the commands that the guide names."""

import shutil
import sqlite3
import subprocess
import time
from pathlib import Path

import pytest
from needs import needs
from refusal_cases import refuse
from relay_cases import client, relay, settings

from bufgym_relay.audit import Audit
from bufgym_relay.config import Rotation
from bufgym_relay.held import FILE
from bufgym_relay.store import Store

BEFORE = Path(__file__).with_name("held_d36707ca.sql")
COMMAND = "/robots/a/command"


@pytest.mark.skipif(shutil.which("sqlite3") is None, reason=needs("sqlite"))
async def test_an_earlier_releases_store_is_backed_up_restored_and_opened(tmp_path: Path) -> None:
    """Command 1 of 3 was acked. 2 and 3 arrive, and 4 follows, although one pattern is no longer taken.

    While a relay has the file, no other may read it.
    """
    held, copy = tmp_path / FILE, tmp_path / "copy.sqlite"

    def sqlite(order: str) -> str:
        done = subprocess.run(["sqlite3", str(held), f"{order} {copy}"], capture_output=True, text=True, check=False)
        return done.stderr

    database = sqlite3.connect(held)
    database.executescript(BEFORE.read_text(encoding="utf-8"))
    database.close()
    assert sqlite(".backup") == ""
    held.unlink()
    assert sqlite(".restore") == ""
    async with (
        relay(settings(folder=tmp_path)) as server,
        client(server.port, session="operator", acked=3) as operator,
        client(server.port, session="robot", received=1) as robot,
    ):
        assert operator.welcome["received"] == 3 and "locked" in sqlite(".backup")
        await robot.came(2, 3)
        await robot.subscribe(f"^{COMMAND}$", durable=True)
        await operator.acked(COMMAND, 4)
        await robot.came(4)


def test_a_store_of_a_later_release_is_refused(tmp_path: Path) -> None:
    database = sqlite3.connect(tmp_path / FILE)
    database.execute("CREATE TABLE session (id INTEGER PRIMARY KEY, title TEXT)")
    database.close()
    given = settings(folder=tmp_path), Audit(None, Rotation()), print, time.monotonic
    refuse("held.sqlite: no such column: .*: must be a relay's own", Store, *given)


def test_a_damaged_store_ends_the_start_in_a_sentence(tmp_path: Path) -> None:
    """The second page of 4,096 bytes, the root of a table, is zeros."""
    given = settings(folder=tmp_path), Audit(None, Rotation()), print, time.monotonic
    Store(*given).close()
    file = tmp_path / FILE
    data = file.read_bytes()
    file.write_bytes(data[:4096] + bytes(4096) + data[8192:])
    refuse("held.sqlite: .*; a damaged one must be moved away, .* or be replaced by a backup", Store, *given)


async def test_what_an_ack_promises_is_synced(tmp_path: Path) -> None:
    """A command that the relay acks, and a durable subscription that it confirms, outlive a power failure.

    SQLite syncs the file at the end of a transaction that is FULL. Sessions and the robot's own ack are not synced.
    """
    said = list[str]()
    async with (
        relay(settings(folder=tmp_path)) as server,
        client(server.port, session="operator") as operator,
        client(server.port, session="robot") as robot,
    ):
        server.hub.store._held._db.set_trace_callback(said.append)
        await robot.subscribe(f"^{COMMAND}$", durable=True)
        await operator.acked(COMMAND, 1)
        await robot.came(1)
        await robot.say("ack", seq=1)
        assert (await operator.next())["op"] == "delivered"
    level = ""
    levels = dict[str, str]()
    for statement in said:
        level = statement.rpartition(" ")[2] if "synchronous" in statement else level
        words = statement.split()
        levels[" ".join(words[: words.index("INTO") + 2 if "INTO" in words else 3])] = level
    assert levels["INSERT INTO message"] == levels["INSERT OR REPLACE INTO durable"] == "FULL"
    assert levels["DELETE FROM delivery"] == levels["INSERT OR REPLACE INTO session"] == "NORMAL"

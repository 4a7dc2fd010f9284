"""What the relay writes: recordings that other commands read, an audit log that does not grow for ever."""

import base64
import itertools
import json
import os
import shutil
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from needs import needs
from refusal_cases import refuse
from relay_cases import ALL, client, full_disk, nothing, process, relay, settings, until, untrusted, wait, within

from bufgym.traces.formats import bags
from bufgym.utils.errors import BufgymError
from bufgym_relay import disk
from bufgym_relay.audit import FILE, Audit
from bufgym_relay.config import Rotation, Rule
from bufgym_relay.recorder import FOLDER, Recorder
from bufgym_relay.replay import answer_text, piece, recordings
from bufgym_robot.wire.mcap_file import McapFile
from bufgym_robot.wire.messages import Message
from bufgym_robot.wire.sockets import free_port

pytest.importorskip("mcap", reason=needs("extras", "mcap"))
RECORD = Rule(recorder=True, receive=True, topic="/robots/.*")


async def test_what_a_rule_allows_is_recorded(tmp_path: Path) -> None:
    async with relay(settings(folder=tmp_path, rules=(ALL, RECORD))) as server, client(server.port) as robot:
        for k in range(40):
            await robot.put("/robots/a/camera", bytes(1_000 + k), encoding="jpeg", seq=k)
            await robot.put("/private/a", b"12")
        await robot.put("/robots/a/odom", b"12", encoding="cdr", type="nav_msgs/msg/Odometry")
        await robot.rest()
    (path,) = (tmp_path / FOLDER).glob("*.mcap")
    bag = bags.read_bag(path)
    assert bag.topics == {"/robots/a/camera": "", "/robots/a/odom": "nav_msgs/msg/Odometry"}
    assert bag.size_bytes.tolist() == [*range(1_000, 1_040), 2]


def test_types_of_ros_are_recorded_with_all_that_they_depend_on(tmp_path: Path) -> None:
    """As ``rosbags`` and Foxglove want them; a type that nobody knows has a name alone."""
    from mcap.reader import make_reader

    one, pose = recorder(tmp_path, []), "geometry_msgs/msg/PoseStamped"
    for k, (encoding, type) in enumerate([("cdr", pose), ("ros1", pose), ("cdr", "my_msgs/msg/Own"), ("cdr", "Odd")]):
        one(Message(f"/robots/a/{k}", b"12", encoding, type))
    one.close()
    (path,) = (tmp_path / FOLDER).glob("*.mcap")
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    cdr, ros1, own, odd = (summary.schemas[channel.schema_id] for _, channel in sorted(summary.channels.items()))
    assert [each.encoding for each in (cdr, ros1)] == ["ros2msg", "ros1msg"] and not own.data and not odd.data
    assert b"MSG: geometry_msgs/Quaternion\nfloat64 x" in cdr.data and b"uint32 seq" in ros1.data


def recorder(folder: Path, payloads: list[bytes], file_bytes: int = 10**6) -> Recorder:
    """One that has written these, of encoding json and jpeg in turn, and has not been closed."""
    config = settings(folder=folder, rules=(RECORD,), recording=Rotation(bytes=file_bytes, files=3))
    one = Recorder.of(config, Audit(None, config.audit))
    assert one is not None
    for k, payload in enumerate(payloads):
        one(Message(f"/robots/{'ab'[k % 2]}", payload, ("json", "jpeg")[k % 2], seq=k))
    return one


def test_recordings_take_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest goes, though the clock is set back an hour for each file. Files of others stay."""
    clock, own = itertools.count(10**9, -3_600), tmp_path / FOLDER / "own.mcap"
    own.parent.mkdir()
    own.write_bytes(b"")
    monkeypatch.setattr("time.gmtime", lambda gmtime=time.gmtime: gmtime(next(clock)))
    recorder(tmp_path, [bytes([k]) * 1_000 for k in range(50)], 10_000).close()
    own.unlink()
    files = sorted((tmp_path / FOLDER).glob("*.mcap"))
    assert len(files) == 3 and all(file.stat().st_size < 13_000 for file in files)
    assert sum(len(bags.read_bag(file).size_bytes) for file in files) < 50
    assert bytes([49]) * 1_000 in files[-1].read_bytes()


async def test_a_deleted_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings begin anew. No command is acked that a restart would not find, and the relay says that it is ill."""
    monkeypatch.setattr("bufgym_relay.recorder.PAUSE_S", 0.0)
    async with relay(settings(folder=tmp_path / "relay", rules=(ALL, RECORD))) as server:
        async with client(server.port) as robot, client(server.port) as viewer:
            await viewer.subscribe("^/robots/a/command$")
            await robot.put("/robots/a/camera")
            await robot.acked("/robots/a/command", 1)
            await until("all to be written", lambda: all(disk.idle for disk in server.hub.disks))
            shutil.rmtree(tmp_path / "relay")
            await robot.command(2, "/robots/a/command")
            said = await robot.next()
            assert said["code"] == "store_full" and "its file was deleted" in said["why"]
            server.hub.tick()
            await robot.put("/robots/a/camera")
            await until("a recording", lambda: len(recordings(tmp_path / "relay" / FOLDER)) == 1)
        async with untrusted(server.port) as (reader, writer):
            writer.write(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert b"503" in await wait("an answer", reader.readline())


def test_ever_new_types_fill_no_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A topic has 16 channels at most, a file 20: of 40 types on /a 16 are kept, then of five topics more four."""
    monkeypatch.setattr("bufgym_robot.wire.mcap_file.MAX_CHANNELS", 20)
    record = recorder(tmp_path, [])
    for k in range(40):
        record(Message("/robots/a", b"1", "cdr", f"my/type{k}", "robot"))
    for k in range(5):
        record(Message(f"/robots/{k}", b"1", "cdr"))
    record(Message("/robots/a", b"again", "cdr", "my/type0"))
    record.close()
    (path,) = (tmp_path / FOLDER).glob("*.mcap")
    bag = bags.read_bag(path)
    assert list(bag.topics) == ["/robots/0", "/robots/1", "/robots/2", "/robots/3", "/robots/a"]
    assert bag.size_bytes.tolist() == [1] * 20 + [5]
    assert isinstance(record._audit, Audit)
    (said,) = record._audit.recent
    assert (said["event"], said["topic"], said["sender"]) == ("recording_full", "/robots/a", "robot")


def every(topic: str) -> bool:
    return True


def test_pieces_are_the_whole(tmp_path: Path) -> None:
    """Six messages of 3 bytes, at most 3 in a piece (or more where they were recorded in the same microsecond)."""
    recorder(tmp_path, [b"100", b"\xff\x01\x02", b"102", b"\xff\x03\x04", b"104", b"\xff\x05\x06"]).close()
    folder = tmp_path / FOLDER
    (file,) = recordings(folder)
    came, next_us = [], 0
    while next_us is not None:
        part = piece(folder, file["name"], next_us, 7, every)
        assert 0 < len(part["messages"]) < 6
        came += part["messages"]
        next_us = part["next_us"]
    assert [(one["topic"], one["seq"]) for one in came] == [(f"/robots/{'ab'[k % 2]}", k) for k in range(6)]
    assert came[2]["data"] == 102 and base64.b64decode(came[3]["data"]) == b"\xff\x03\x04"
    assert (came[0]["stamp_us"], came[-1]["stamp_us"]) == (part["first_us"], part["last_us"])
    later = piece(folder, file["name"], came[4]["stamp_us"], 100, lambda topic: topic.endswith("/b"))
    assert later["messages"][-1]["seq"] == 5 and all(one["topic"] == "/robots/b" for one in later["messages"])


def test_a_recording_that_is_being_written_goes_on(tmp_path: Path) -> None:
    record, folder = recorder(tmp_path, [b"1", b"2"]), tmp_path / FOLDER
    record._file.file.flush()  # type: ignore[union-attr]
    name = recordings(folder)[0]["name"]

    def meanwhile(topic: str) -> bool:
        """Another topic comes while a piece is read."""
        if topic == "/robots/a":
            record(Message("/robots/c", b"3"))
            record._file.file.flush()  # type: ignore[union-attr]
        return True

    first = piece(folder, name, 0, 100, meanwhile)
    record.close()
    second = piece(folder, name, first["last_us"] + 1, 100, every)
    assert len(first["messages"]) == 2 and [one["topic"] for one in second["messages"]] == ["/robots/c"]


def test_only_recordings_are_read(tmp_path: Path) -> None:
    assert recordings(None) == [] and recordings(tmp_path / "none") == []
    (tmp_path / "own.mcap").write_bytes(b"no recording at all")
    for name in ("../own.mcap", "/etc/passwd", "", "none.mcap"):
        refuse("there is none of this name", piece, tmp_path, name, 0, 1, every)
    refuse(r"recording own\.mcap: must be an MCAP file", piece, tmp_path, "own.mcap", 0, 1, every)
    (tmp_path / "gone.mcap").symlink_to(tmp_path / "none")  # listed by the system, and not to be found
    assert [one["name"] for one in recordings(tmp_path)] == ["own.mcap"]
    file = McapFile(tmp_path / "own.mcap")
    file.write("/a", b"1", 1, 1, schema="object")
    file.close()
    whole, refused = (tmp_path / "own.mcap").read_bytes(), 0
    for k in range(8, len(whole)):  # each byte in turn is another one, and the file is read or refused
        (tmp_path / f"{k}.mcap").write_bytes(whole[:k] + bytes([whole[k] ^ 0xFF]) + whole[k + 1 :])
        try:
            answer_text("a", tmp_path, f"{k}.mcap", 0, 1, every)
        except BufgymError as error:
            refused += str(error).startswith(f"recording '{k}.mcap': cannot be read")
        (tmp_path / f"{k}.mcap").unlink()
    assert refused > 10


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
async def test_a_recording_outlives_its_relay(tmp_path: Path, end: signal.Signals) -> None:
    """Asked to end, the relay finishes its files. Killed, it leaves all that it had written."""
    port = free_port("127.0.0.1")
    rule = '[[rules]]\nrecorder = true\nreceive = true\ntopic = "/robots/.*"\n'
    async with process(port, tmp_path, rule) as one, client(port) as robot:
        for _ in range(20):
            await robot.put("/robots/a/odom", b"o" * 1_000)
        await robot.rest()
        await until("a recording", lambda: list((tmp_path / "held" / FOLDER).glob("*.mcap")))
        (path,) = (tmp_path / "held" / FOLDER).glob("*.mcap")
        if end == signal.SIGKILL:  # the file's last messages are in a buffer until a tick
            await until("all 20 in the file", lambda: path.read_bytes().count(b"o" * 1_000) == 20)
        one.send_signal(end)
        assert await wait("its end", one.wait()) == (0 if end == signal.SIGTERM else -end)
    assert bags.read_bag(path).size_bytes.tolist() == [1_000] * 20
    if end == signal.SIGKILL:
        os.truncate(path, path.stat().st_size - 10)  # in the midst of its last message
        assert bags.read_bag(path).size_bytes.tolist() == [1_000] * 19


async def test_a_full_disk_stops_no_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What needs the disk is refused or left out, and logged; the rest is forwarded, and all recovers."""
    monkeypatch.setattr("bufgym_relay.server.TICK_S", 0.01)
    monkeypatch.setattr("bufgym_relay.recorder.PAUSE_S", 0.01)
    async with relay(settings(folder=tmp_path, rules=(ALL, RECORD))) as server:

        def events() -> list[str]:
            return [entry["event"] for entry in server.hub.audit.recent]

        async with client(server.port, session="v") as viewer, client(server.port) as robot:
            await viewer.subscribe("^/robots/a/", durable=True)
            await robot.acked("/robots/a/command", 1)
            await viewer.came(1)
            await until("its record", lambda: any(p.stat().st_size for p in (tmp_path / FOLDER).glob("*.mcap")))
            with full_disk():
                await viewer.say("subscribe", id="status", topic="^/relay/status$")
                assert (await viewer.next())["op"] == "subscribed"
                for _ in range(20):  # ticks
                    assert (await viewer.next()).topic == "/relay/status"
                await viewer.say("unsubscribe", id="status")
                await viewer.rest()
                await robot.put("/robots/a/odom", b"12")
                assert (await viewer.next()).payload == b"12"
                await robot.command(2, "/robots/a/command")
                assert (await robot.next())["code"] == "store_full"
                assert server.hub.ills[0].startswith("the store cannot be written: ")
                await viewer.say("ack", seq=1)
                assert (await viewer.subscribe("b", "b", durable=True))["code"] == "store_full"
                await until("its log", lambda: "recording_failed" in events())
                async with client(server.port) as another:
                    assert another.welcome["op"] == "welcome"
            await robot.command(2, "/robots/a/command")  # its ack and the first one's outcome come in either order
            said = [await robot.next() for _ in range(2)]
            assert {"op": "ack", "seq": 2} in said
            assert {"op": "delivered", "seq": 1, "receivers": 1, "lost": 0} in said
            await viewer.came(2)
            assert (await viewer.subscribe("b", "b", durable=True))["op"] == "subscribed"
            await viewer.say("ack", seq=2)
            assert await nothing(viewer)
            assert server.hub.status()["held"] == 0 and server.hub.ills == []
            async with within("the recorder"):
                while "recording_resumed" not in events():
                    await robot.put("/robots/b/odom")
                    await robot.rest()
    assert events().count("recording_failed") == events().count("recording_resumed") == 1 and "failed" not in events()
    written = [entry["event"] for entry in entries(tmp_path)]
    assert written.count("lost") == 1 and written[-1] == "left"
    assert len(list((tmp_path / FOLDER).glob("*.mcap"))) == 2


def entries(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for file in sorted(folder.glob(f"{FILE}*")) for line in file.read_text().splitlines()]


def test_the_audit_log_takes_turns(tmp_path: Path) -> None:
    audit = Audit(tmp_path, Rotation(bytes=1_000, files=2))
    for k in range(100):
        audit("joined", session=str(k))
    audit.close()
    files = sorted(tmp_path.glob(f"{FILE}*"))
    assert len(files) == 3 and all(file.stat().st_size <= 1_000 for file in files)
    assert entries(tmp_path)[-1]["event"] == "joined"


def test_repeated_refusals_are_counted(tmp_path: Path) -> None:
    audit = Audit(tmp_path, Rotation())
    assert [audit.repeated(code="too_fast", topic="/a\n\x1b[31m" + "x" * 400) for _ in range(5)] == [True] + [False] * 4
    assert audit.repeated(code="too_fast", topic="/b")
    audit.flush()
    assert audit.repeated(code="too_fast", topic="/b")
    audit.close()
    lines = entries(tmp_path)
    assert [line.get("times") for line in lines] == [None, None, 4, None] and audit.refused == 7
    assert str(lines[0]["topic"]).startswith("/a\\n\\x1b[31m") and len(str(lines[0]["topic"])) < 310


async def test_while_the_disk_stalls_messages_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recorder's disk stands still: a viewer gets what the recorder waits to write, and 100 kB are left out."""
    monkeypatch.setattr("bufgym_relay.server.TICK_S", 0.01)
    monkeypatch.setattr(disk, "STALL_S", 0.05)
    monkeypatch.setattr(disk, "MOST_BYTES", 100_000)
    go, write = threading.Event(), McapFile.write

    def stalled(*words: Any, **fields: Any) -> bool:
        assert go.wait(60.0)
        return write(*words, **fields)

    monkeypatch.setattr(McapFile, "write", stalled)
    config = settings(folder=tmp_path, rules=(ALL, RECORD))
    async with relay(config) as server, client(server.port) as viewer, client(server.port) as robot:
        await viewer.subscribe("^/robots/a/odom$")

        def events() -> list[str]:
            return [entry["event"] for entry in server.hub.audit.recent]

        for size in (1, 2, 100_000, 3):
            await robot.put("/robots/a/odom", bytes(size))
            assert len((await viewer.next()).payload) == size
        await until("its log", lambda: "disk_stalls" in events())
        assert "disk_goes_on" not in events()
        go.set()
        await until("its log", lambda: {"disk_goes_on", "left_out"} <= set(events()))
    (path,) = (tmp_path / FOLDER).glob("*.mcap")
    assert bags.read_bag(path).size_bytes.tolist() == [1, 2, 3]

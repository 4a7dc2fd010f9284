"""What the relay writes: recordings that other commands read, an audit log that does not grow for ever."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from relay_cases import ALL, client, in_folder, relay, run

from bufgym import cli
from bufgym.relay.audit import FILE, Audit
from bufgym.relay.config import Rotation, Rule
from bufgym.relay.recorder import FOLDER
from bufgym.traces.formats import bags

RECORD = Rule(recorder=True, receive=True, topic="/robots/.*")


def test_what_a_rule_allows_is_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mcap")

    async def story() -> None:
        async with relay(in_folder(tmp_path, rules=(ALL, RECORD))) as server, client(server.port) as robot:
            await robot.subscribe("nothing")
            for k in range(40):
                await robot.put("/robots/a/camera", bytes(1_000 + k), encoding="jpeg", seq=k)
                await robot.put("/private/a", b"12")
            await robot.put("/robots/a/odom", b"12", encoding="cdr", type="nav_msgs/msg/Odometry")
            await robot.subscribe("that all has come")

    run(story)
    (path,) = (tmp_path / FOLDER).glob("*.mcap")
    bag = bags.read_bag(path)
    assert bag.topics == {"/robots/a/camera": "", "/robots/a/odom": "nav_msgs/msg/Odometry"}
    assert bag.size_bytes.tolist() == [*range(1_000, 1_040), 2]
    words = ["bench", "--workload", str(path), "--policies", "afr", "--capacity", "2", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 0 and "afr" in capsys.readouterr().out


def test_recordings_take_turns(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    rotation = Rotation(bytes=10_000, files=3)

    async def story() -> None:
        config = in_folder(tmp_path, rules=(ALL, RECORD), recording=rotation)
        async with relay(config) as server, client(server.port) as robot:
            for _ in range(50):
                await robot.put("/robots/a/camera", bytes(1_000))
            await robot.subscribe("that all has come")

    run(story)
    files = sorted((tmp_path / FOLDER).glob("*.mcap"))
    assert len(files) == 3 and all(file.stat().st_size < 13_000 for file in files)
    assert sum(len(bags.read_bag(file).size_bytes) for file in files) < 50


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

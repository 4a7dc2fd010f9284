"""``bufgym live``, as a user types it."""

from __future__ import annotations

import socket
import threading
import time
from pathlib import Path

import pytest

from bufgym.cli import main


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def test_send_receive_and_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = str(free_port())
    came, log = tmp_path / "came.mcap", tmp_path / "log.mcap"
    receiving = threading.Thread(
        target=main, args=(["live", "receive", "--port", port, "--messages", "30", "--out", str(came)],), daemon=True
    )
    receiving.start()
    out, patience = "", time.monotonic() + 60
    while "listening" not in out and time.monotonic() < patience:
        time.sleep(0.05)
        out += capsys.readouterr().out
    room = ["--capacity", "64"]  # however slow the machine is: nothing is dropped
    sent = main(["live", "send", f"127.0.0.1:{port}", "--size", "1000", "--duration", "1", *room, "--log", str(log)])
    receiving.join(30)
    assert sent == 0 and not receiving.is_alive()
    assert main(["live", "replay", str(log)]) == 0
    out += capsys.readouterr().out
    assert "30 received; 0 broken connections" in out
    assert "30 put, 30 delivered, 0 dropped" in out and "makes the same decisions" in out
    assert main(["bench", "--workload", str(came), "--topics", "/topic_0", "--trace", "lte-synthetic-0"]) == 0


def test_validate_prints_both_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "--trace",
        "lte-synthetic-0",
        "--policies",
        "afr",
        "--duration",
        "2",
        "--size",
        "50000",
        "--speed",
        "2",
        "--transport",
        "tcp",
        "websocket",
        "--out",
        str(tmp_path),
    ]
    assert main(["live", "validate", *arguments]) == 0
    out = capsys.readouterr().out
    assert "| afr |" in out and "2 runs" in out
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "bufgym live validate --trace lte-synthetic-0 --policies afr" in page and "--transport tcp websocket" in page


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["send", "robot"], "robot: must be HOST:PORT"),
        (["link", "--trace", "lte-synthetic-0", "--to", "robot:99999"], "robot:99999: must be HOST:PORT"),
        (["replay", "none.mcap"], "none.mcap: No such file"),
    ],
)
def test_mistakes_are_told(words: list[str], fault: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live", *words]) == 2
    assert fault in capsys.readouterr().err

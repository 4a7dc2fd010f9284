"""Recordings piece by piece, for the page."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest
from relay_cases import in_folder

from bufgym.errors import BufgymError
from bufgym.relay.config import Rotation, Rule
from bufgym.relay.recorder import FOLDER, Recorder
from bufgym.relay.replay import piece, recordings
from bufgym.relay.wire import Message

pytest.importorskip("mcap", reason="no mcap here: the extra relay")


def recorded(folder: Path, payloads: list[bytes]) -> Recorder:
    """A recorder that has written these, of encoding json and jpeg in turn, and has not been closed."""
    rules = (Rule(recorder=True, receive=True),)
    recorder = Recorder.of(in_folder(folder, rules=rules, recording=Rotation(bytes=10**6)))
    assert recorder is not None
    for k, payload in enumerate(payloads):
        recorder(Message(f"/{'ab'[k % 2]}", payload, ("json", "jpeg")[k % 2], seq=k))
    return recorder


def test_pieces_are_the_whole(tmp_path: Path) -> None:
    """Six messages of 3 bytes, at most 3 in a piece (or more where they were recorded in the same microsecond)."""
    recorder = recorded(tmp_path, [b"100", b"\xff\x01\x02", b"102", b"\xff\x03\x04", b"104", b"\xff\x05\x06"])
    recorder.close()
    folder = tmp_path / FOLDER
    (file,) = recordings(folder)
    came, next_us = [], 0
    while next_us is not None:
        part = piece(folder, file["name"], next_us, 7, lambda topic: True)
        assert 0 < len(part["messages"]) < 6
        came += part["messages"]
        next_us = part["next_us"]
    assert [(one["topic"], one["seq"]) for one in came] == [(f"/{'ab'[k % 2]}", k) for k in range(6)]
    assert came[2]["data"] == 102 and base64.b64decode(came[3]["data"]) == b"\xff\x03\x04"
    assert (came[0]["stamp_us"], came[-1]["stamp_us"]) == (part["first_us"], part["last_us"])
    later = piece(folder, file["name"], came[4]["stamp_us"], 100, lambda topic: topic == "/b")
    assert [one["seq"] for one in later["messages"]][-1] == 5 and all(one["topic"] == "/b" for one in later["messages"])


def test_a_recording_that_is_being_written_goes_on(tmp_path: Path) -> None:
    recorder, folder = recorded(tmp_path, [b"1", b"2"]), tmp_path / FOLDER
    recorder._file.flush()  # type: ignore[union-attr]
    name = recordings(folder)[0]["name"]
    first = piece(folder, name, 0, 100, lambda topic: True)
    recorder(Message("/c", b"3"))
    recorder.close()
    second = piece(folder, name, first["last_us"] + 1, 100, lambda topic: True)
    assert len(first["messages"]) == 2 and [one["topic"] for one in second["messages"]] == ["/c"]


def test_only_recordings_are_read(tmp_path: Path) -> None:
    assert recordings(None) == [] and recordings(tmp_path / "none") == []
    (tmp_path / "own.mcap").write_bytes(b"no recording at all")
    for name in ("../own.mcap", "/etc/passwd", "", "none.mcap"):
        with pytest.raises(BufgymError, match="there is none of this name"):
            piece(tmp_path, name, 0, 1, lambda topic: True)
    with pytest.raises(BufgymError, match=r"recording own\.mcap: must be an MCAP file"):
        piece(tmp_path, "own.mcap", 0, 1, lambda topic: True)

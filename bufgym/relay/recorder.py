"""Recorder of the messages that its rules allow, in MCAP files that ``bufgym bench --workload`` reads."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, BinaryIO, Final

from bufgym.relay import wire
from bufgym.relay.config import Config, Rotation
from bufgym.relay.rules import RECORDER, Permissions

FOLDER: Final = "recordings"
_FLUSH_S: Final = 0.5
"""Time between flushes; a killed relay loses its recording since the last one."""
SCHEMAS: Final = {"json": "jsonschema", "cdr": "ros2msg", "ros1": "ros1msg"}
"""Encoding -> format of its schemas in MCAP."""


class Recorder:
    """Writes each message that it may receive; after ``rotation.bytes`` it begins the next file."""

    def __init__(self, folder: Path, rotation: Rotation, permissions: Permissions) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._rotation = rotation
        self._permissions = permissions
        self._file: BinaryIO | None = None
        self._writer: Any = None
        self._channels: dict[tuple[str, str, str], int] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._flushed_s = 0.0

    @classmethod
    def of(cls, config: Config) -> Recorder | None:
        """Make the recorder if the relay has a folder and a rule that lets it record."""
        permissions = Permissions(config.rules, RECORDER)
        if config.folder is None or not permissions.rules:
            return None
        return cls(config.folder / FOLDER, config.recording, permissions)

    def __call__(self, message: wire.Message) -> None:
        """Write a message if a rule allows it."""
        if not self._permissions.allow("receive", message.topic):
            return
        if self._file is not None and self._file.tell() + len(message.payload) > self._rotation.bytes:
            self.close()
        if self._file is None:
            self._begin()
        assert self._file is not None
        now_ns = time.time_ns()
        self._writer.add_message(
            self._channel(message),
            log_time=now_ns,
            publish_time=max(0, message.stamp_us) * 1000,
            sequence=message.seq % 2**32,
            data=bytes(message.payload),
        )
        if time.monotonic() - self._flushed_s >= _FLUSH_S:
            self._file.flush()
            self._flushed_s = time.monotonic()

    def _begin(self) -> None:
        """Begin the next file and delete the oldest."""
        from mcap.writer import Writer

        files = sorted(self.folder.glob("*.mcap"))
        for path in files[: max(0, len(files) + 1 - self._rotation.files)]:
            path.unlink()
        now_s, now_ns = divmod(time.time_ns(), 10**9)  # a single clock reading keeps names in the order of the files
        path = self.folder / f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime(now_s))}-{now_ns:09}.mcap"
        self._file = path.open("xb")
        # Chunks would be lost with the process.
        self._writer = Writer(self._file, use_chunking=False)
        self._writer.start(profile="", library="bufgym")
        self._channels, self._schemas = {}, {}

    def _channel(self, message: wire.Message) -> int:
        key = message.topic, message.encoding, message.type
        if key not in self._channels:
            schema = 0
            if message.type or message.encoding == "json":
                schema = self._schema(message.encoding, message.type or "object")
            self._channels[key] = self._writer.register_channel(message.topic, message.encoding, schema)
        return self._channels[key]

    def _schema(self, encoding: str, type: str) -> int:
        key = encoding, type
        if key not in self._schemas:
            text = b'{"type": "object"}' if encoding == "json" else b""
            self._schemas[key] = self._writer.register_schema(type, SCHEMAS.get(encoding, ""), text)
        return self._schemas[key]

    def close(self) -> None:
        """Finish the file."""
        if self._file is not None:
            self._writer.finish()
            self._file.close()
            self._file = None

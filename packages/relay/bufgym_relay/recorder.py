"""Recorder of the messages that its rules allow, in MCAP files that ``bufgym bench --workload`` reads."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from bufgym_relay.config import Config, Rotation, Rule
from bufgym_relay.disk import Disk
from bufgym_relay.rules import RECORDER, Permissions
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire import ros_messages
from bufgym_robot.wire.mcap_file import McapFile

FOLDER: Final = "recordings"
PAUSE_S: Final = 10.0
SCHEMAS: Final = {"json": "jsonschema", "cdr": "ros2msg", "ros1": "ros1msg"}
"""Encoding -> format of its schemas in MCAP."""


class Recorder:
    """Writes each message that it may receive; after ``rotation.bytes`` it begins the next file.

    A message that needs one channel too many (``robot.mcap_file``) is left out, which the audit log says once a file.
    If the disk takes nothing, the recorder pauses for ``PAUSE_S`` and then begins the next file.
    """

    def __init__(self, folder: Path, rotation: Rotation, permissions: Permissions, audit: Callable[..., None]) -> None:
        self.folder = folder
        self._rotation, self.permissions, self._audit = rotation, permissions, audit
        self._file: McapFile | None = None
        self._full = False  # whether it was said of this file
        self._again_s = 0.0  # end of the pause after a failure, 0 if there was none

    @classmethod
    def of(cls, config: Config, audit: Callable[..., None]) -> Recorder | None:
        """Make the recorder if the relay has a folder and a rule that lets it record."""
        permissions = Permissions(config.rules, RECORDER)
        if config.folder is None or not permissions.rules:
            return None
        return cls(config.folder / FOLDER, config.recording, permissions, audit)

    def wants(self, topic: str) -> bool:
        """Whether a rule allows messages of the topic."""
        return self.permissions.allow("receive", topic)

    def __call__(self, message: wire.Message, came_ns: int | None = None) -> None:
        """Write a message, which has come then or now, if a rule allows it."""
        if not self.wants(message.topic) or time.monotonic() < self._again_s:
            return
        try:
            self._write(message, came_ns or time.time_ns())
        except OSError as error:
            self._failed(error)
            return
        if self._again_s:
            self._again_s = 0.0
            self._audit("recording_resumed")

    def _write(self, message: wire.Message, came_ns: int) -> None:
        if self._file is not None and self._file.file.tell() + len(message.payload) > self._rotation.bytes:
            self.close()
        if self._file is None:
            self._file = self._next()
        times_ns, encoding = (came_ns, max(0, message.stamp_us) * 1000), message.encoding
        schema = message.type or ("object" if encoding == "json" else "")
        form: dict[str, Any] = {"encoding": encoding, "schema": schema, "schema_encoding": SCHEMAS.get(encoding, "")}
        form["definition"] = ros_messages.definition(schema, encoding)
        written = self._file.write(message.topic, bytes(message.payload), *times_ns, seq=message.seq, **form)
        if not (written or self._full):
            self._full = True
            self._audit("recording_full", file=self._file.path.name, topic=message.topic, sender=message.sender)

    def _next(self) -> McapFile:
        """Begin the next file and delete the oldest. Names begin with a number, because clocks are set back."""
        self.folder.mkdir(parents=True, exist_ok=True)
        files = sorted(self.folder.glob(8 * "[0-9]" + "-*.mcap"))
        number = 1 + max((int(path.name[:8]) for path in files), default=0)
        for path in files[: max(0, len(files) + 1 - self._rotation.files)]:
            path.unlink()
        return McapFile(self.folder / f"{number:08}-{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}.mcap", "xb")

    def flush(self) -> None:
        """Flush the file."""
        try:
            if self._file is not None:
                self._file.flush()
                self._file.path.stat()  # it may have been deleted
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> None:
        """Give the file up with its messages, and pause."""
        if not self._again_s:
            self._audit("recording_failed", why=error.strerror or str(error), pause_s=PAUSE_S)
        self._again_s = time.monotonic() + PAUSE_S
        file, self._file, self._full = self._file, None, False
        if file is not None:
            file.abandon()

    def close(self) -> None:
        """Finish the file."""
        file, self._file, self._full = self._file, None, False
        if file is not None:
            try:
                file.close()
            except OSError:
                file.abandon()  # it can be read as far as it goes


class Tape:
    """A recorder in a thread of its own."""

    def __init__(self, recorder: Recorder, disk: Disk) -> None:
        self._recorder, self.disk = recorder, disk

    def __call__(self, message: wire.Message) -> None:
        """Have a message written."""
        if self._recorder.wants(message.topic):
            self.disk.soon(len(message.payload), self._recorder, message, time.time_ns())

    def reruled(self, rules: Sequence[Rule]) -> None:
        """Take new rules."""
        self._recorder.permissions = Permissions(rules, RECORDER)

    def tick(self) -> None:
        """Have the file flushed."""
        if self.disk.idle:
            self.disk.soon(0, self._recorder.flush)

    def close(self) -> None:
        """Finish the file, when all is written."""
        self.disk.close(self._recorder.close)

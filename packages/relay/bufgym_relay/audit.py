"""Audit log of connections and refusals: JSON lines in rotated files, written in a thread of its own.

A client that is refused the same thing a thousand times a second makes one line a second, with the count.
"""

import json
import os
import time
from collections import Counter, deque
from contextlib import suppress
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any, Final

from bufgym.utils.errors import printable
from bufgym_relay.config import Rotation
from bufgym_relay.disk import Disk

FILE: Final = "audit.jsonl"
_MOST_CHARACTERS: Final = 300  # length limit of a text from outside
_RECENT: Final = 1_000


class _Lines(RotatingFileHandler):
    """Rotated files without the ceremony of log records."""

    def write(self, text: str) -> None:
        """Write whole lines; raise OSError and leave no part of them if they cannot be written."""
        before = None
        try:
            if self.stream is None:
                self.stream = self._open()
            if self.stream.tell() + len(text) > self.maxBytes:
                self.doRollover()
            before = self.stream.tell()
            self.stream.write(text)
            self.stream.flush()
        except OSError:
            with suppress(OSError):
                super().close()
            with suppress(OSError):
                if before is not None:
                    os.truncate(self.baseFilename, before)
            raise


class Audit:
    """The log; in memory alone without a folder."""

    def __init__(self, folder: Path | None, rotation: Rotation) -> None:
        self.recent: deque[dict[str, Any]] = deque(maxlen=_RECENT)  # the last entries
        self.refusals: Counter[str] = Counter()  # code -> how often it was refused
        self._lost = 0  # entries that the disk did not take; the next one that it takes follows their count
        self._repeated: Counter[tuple[str, ...]] = Counter()
        self.disk = None if folder is None else Disk("audit log", self)
        if folder is not None:
            path = folder / FILE
            self._lines = _Lines(path, maxBytes=rotation.bytes, backupCount=rotation.files, encoding="utf-8")

    def __call__(self, event: str, **fields: Any) -> None:
        """Have one entry written."""
        entry = {"at": round(time.time(), 6), "event": event}
        entry |= {name: _short(value) for name, value in fields.items()}
        self.recent.append(entry)
        if event == "refused":
            self.refusals[str(fields.get("code", "other"))] += fields.get("times", 1)
        if self.disk is not None:
            self.disk.soon(0, self._write, entry)

    def _write(self, entry: dict[str, Any]) -> None:
        gap = [{"at": entry["at"], "event": "lost", "entries": self._lost}] if self._lost else []
        text = "".join(json.dumps(one, separators=(",", ":")) + "\n" for one in (*gap, entry))
        try:
            self._lines.write(text)
            self._lost = 0
        except OSError:
            self._lost += 1

    @property
    def refused(self) -> int:
        """Refusals of all codes."""
        return self.refusals.total()

    def repeated(self, **fields: str) -> bool:
        """Log a refusal that may come often: write the first at once, and leave the count of the rest to ``flush``.

        Return whether it is the first.
        """
        key = tuple(item for pair in sorted(fields.items()) for item in pair)
        first = key not in self._repeated
        if first and len(self._repeated) < 10 * _RECENT:
            self._repeated[key] = 0
            self("refused", **fields)
        else:
            self._repeated[key if not first else ("what", "others")] += 1
        return first

    def flush(self) -> None:
        """Write how often each refusal was repeated since the last flush."""
        repeated, self._repeated = self._repeated, Counter()
        for key, times in repeated.items():
            if times:
                self("refused", **dict(zip(key[::2], key[1::2], strict=True)), times=times)

    def close(self) -> None:
        """Finish the file."""
        self.flush()
        if self.disk is not None:
            self.disk.close(self._lines.close)


def _short(value: Any) -> Any:
    if isinstance(value, str):
        text = printable(value)
        return text if len(text) <= _MOST_CHARACTERS else f"{text[:_MOST_CHARACTERS]}..."
    return value

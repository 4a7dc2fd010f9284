"""One writer of MCAP files, for logs, received messages and a relay's recordings."""

import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Self

MAX_CHANNELS: Final = 30_000  # Channels of a file. MCAP itself numbers at most 65,535.
MAX_FORMS: Final = 16  # Channels of one topic, which differ in encoding or schema
_MOST_NS: Final = 2**64 - 1
_FLUSH_S: Final = 0.5  # time between flushes; a killed program loses what it has written since the last one


class McapFile:
    """A new MCAP file without chunks, which would be lost with the process. One that is cut short can be read too."""

    def __init__(self, path: str | Path, mode: str = "wb") -> None:
        from mcap.writer import Writer

        self.path = Path(path)
        self.file: Any = self.path.open(mode)
        self._writer: Any = Writer(self.file, use_chunking=False)
        self._writer.start(profile="", library="bufgym")
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}
        self._forms: Counter[str] = Counter()
        self._flushed_s = 0.0
        self._holds = False  # whether a message was written

    def write(
        self,
        topic: str,
        data: bytes,
        log_ns: int,
        publish_ns: int,
        *,
        encoding: str = "json",
        schema: str = "",
        schema_encoding: str = "jsonschema",
        definition: bytes = b"",
        seq: int = 0,
    ) -> bool:
        """Add a message; ``schema`` is the name of its type, empty for none, ``definition`` its text.

        Return False and add nothing if it needs one channel more than ``MAX_CHANNELS`` or ``MAX_FORMS``.
        """
        key, kind = (topic, encoding, schema), (schema, schema_encoding)
        if key not in self._channels:
            if len(self._channels) >= MAX_CHANNELS or self._forms[topic] >= MAX_FORMS:
                return False
            self._forms[topic] += 1
            if schema and kind not in self._schemas:
                text = b'{"type": "object"}' if schema_encoding == "jsonschema" else definition
                self._schemas[kind] = self._writer.register_schema(schema, schema_encoding, text)
            self._channels[key] = self._writer.register_channel(topic, encoding, self._schemas.get(kind, 0))
        times = {"log_time": min(log_ns, _MOST_NS), "publish_time": min(publish_ns, _MOST_NS)}
        self._writer.add_message(self._channels[key], **times, sequence=seq % 2**32, data=data)
        if time.monotonic() - self._flushed_s >= _FLUSH_S:
            self.flush()
        self._holds = True
        return True

    def flush(self) -> None:
        """Flush the file."""
        self.file.flush()
        self._flushed_s = time.monotonic()

    def close(self) -> None:
        """Finish the file."""
        if not self.file.closed:
            self._writer.finish()
            self.file.close()

    def abandon(self) -> None:
        """Close the file as it is, and delete it if it holds no message."""
        with suppress(OSError):
            self.file.close()
        if not self._holds:
            self.path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

"""One writer of MCAP files, for logs, received messages and a relay's recordings (extra ``live``)."""

import time
from pathlib import Path
from typing import Any, Final, Self

from bufgym.robot.extra import needs

_FLUSH_S: Final = 0.5  # time between flushes; a killed program loses what it has written since the last one


class McapFile:
    """A new MCAP file without chunks, which would be lost with the process. One that is cut short can be read too."""

    def __init__(self, path: str | Path, mode: str = "wb") -> None:
        with needs("mcap"):
            from mcap.writer import Writer
        self.path = Path(path)
        self.file: Any = self.path.open(mode)
        self._writer: Any = Writer(self.file, use_chunking=False)
        self._writer.start(profile="", library="bufgym")
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}
        self._flushed_s = 0.0

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
        seq: int = 0,
    ) -> None:
        """Add a message; ``schema`` is the name of its type, empty for none."""
        key, kind = (topic, encoding, schema), (schema, schema_encoding)
        if schema and kind not in self._schemas:
            text = b'{"type": "object"}' if schema_encoding == "jsonschema" else b""
            self._schemas[kind] = self._writer.register_schema(schema, schema_encoding, text)
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(topic, encoding, self._schemas.get(kind, 0))
        self._writer.add_message(
            self._channels[key], log_time=log_ns, publish_time=publish_ns, sequence=seq % 2**32, data=data
        )
        now_s = time.monotonic()
        if now_s - self._flushed_s >= _FLUSH_S:
            self.file.flush()
            self._flushed_s = now_s

    def close(self) -> None:
        """Finish the file."""
        if not self.file.closed:
            self._writer.finish()
            self.file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

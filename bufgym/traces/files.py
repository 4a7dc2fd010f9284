"""Text files from outside, read with suspicion: gzip or not, bounded in size and line length, errors with a
line number.

Every reader of this package gets its lines here, so that a directory, a cut-off download, a binary file or a
compression bomb ends in the same clear `TraceError` whatever the format.
"""

from __future__ import annotations

import gzip
import io
import re
import zlib
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import IO, Final, NamedTuple

from bufgym.errors import TraceError, where

StrPath = str | PathLike[str]

# Text after decompression; reading stops as soon as it is passed.
MAX_TEXT_BYTES: Final = 4 * 2**30
MAX_LINE_CHARACTERS: Final = 4096

_GZIP_MAGIC = b"\x1f\x8b"
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
# What int() and float() take is wider than what a data file should hold ("1_000", "infinity", digits of
# other scripts).
_WHOLE = re.compile(r"[0-9]+")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_MILLISECONDS = re.compile(r"([0-9]+)(?:\.([0-9]{1,3})0*)?")


def is_number(text: str) -> bool:
    """Whether `text` is a plain finite decimal number."""
    return _NUMBER.fullmatch(text) is not None


class Line(NamedTuple):
    """A line of a file, and how to take numbers from it.

    Each method raises a TraceError that names file, line, value and rule.
    """

    path: StrPath
    number: int
    text: str

    def error(self, value: object | None, rule: str, field: str | None = None) -> TraceError:
        """The error to raise about this line."""
        return TraceError(where(self.path, self.number, value, rule, field=field))

    def columns(self, count: int, separator: str | None = None) -> list[str]:
        """The line's cells, which must be `count`; split at white space unless a separator is given."""
        cells = [cell.strip() for cell in self.text.split(separator)]
        if len(cells) != count:
            raise self.error(self.text, f"must have {count} columns, has {len(cells)}")
        return cells

    def whole(self, field: str, text: str, most: int) -> int:
        """A whole number from 0 to `most`."""
        if not _WHOLE.fullmatch(text):
            raise self.error(text, "must be a whole number >= 0", field)
        value = int(text)
        if value > most:
            raise self.error(text, f"must be at most {most}", field)
        return value

    def decimal(self, field: str, text: str, least: float, most: float) -> float:
        """A finite number from `least` to `most`."""
        if not _NUMBER.fullmatch(text):
            raise self.error(text, "must be a finite number", field)
        value = float(text)
        if not least <= value <= most:
            raise self.error(text, f"must be from {least:g} to {most:g}", field)
        return value

    def milliseconds(self, field: str, text: str, most_s: int) -> int:
        """A time >= 0 in ms with at most three decimals, as exact microseconds."""
        match = _MILLISECONDS.fullmatch(text)
        if not match:
            raise self.error(text, "must be a number of ms >= 0 with at most 3 decimals", field)
        value = int(match[1]) * 1000 + int((match[2] or "").ljust(3, "0"))
        if value > most_s * 1_000_000:
            raise self.error(text, f"must be at most {most_s} s", field)
        return value


class TextFile:
    """A text file opened for one pass, plain or gzip (told by its first two bytes, whatever its name).

    Use as a context manager, and then either `lines` or `read`.

    Raises:
        TraceError: missing, not a regular file, unreadable, damaged or cut-off gzip, more than
            MAX_TEXT_BYTES.
    """

    def __init__(self, path: StrPath) -> None:
        self.path = path
        self._read_bytes = 0

    def __enter__(self) -> TextFile:
        path = Path(self.path)
        try:
            if path.is_dir():
                raise TraceError(where(self.path, None, None, "is a directory: must be a file"))
            if not path.exists():
                raise TraceError(where(self.path, None, None, "no such file"))
            if not path.is_file():
                raise TraceError(where(self.path, None, None, "must be a regular file"))
            raw = path.open("rb")
        except OSError as error:
            raise TraceError(where(self.path, None, None, f"cannot be opened: {error.strerror or error}")) from error
        self._raw = raw
        zipped = raw.peek(2)[:2] == _GZIP_MAGIC
        self._stream: IO[bytes] = io.BufferedReader(gzip.GzipFile(fileobj=raw)) if zipped else raw
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()
        self._raw.close()

    def read(self, count: int, line: int) -> bytes:
        """Up to `count` bytes, empty at the end; `line` is the number that an error message gives."""
        return self._take(count, line, whole_line=False)

    def lines(self) -> Iterator[Line]:
        """The lines that are not blank, numbered from 1, without surrounding white space.

        Raises:
            TraceError: additionally a line over MAX_LINE_CHARACTERS, or one that is not UTF-8.
        """
        number = 0
        # Two more than the limit, so that a line just as long still comes with its end ("\r\n").
        while raw := self._take(MAX_LINE_CHARACTERS + 2, number + 1, whole_line=True):
            number += 1
            try:
                text = raw.decode("utf-8").strip()
            except UnicodeDecodeError as error:
                rule = f"must be UTF-8 text (byte {error.start + 1} is not)"
                raise TraceError(where(self.path, number, raw[:60], rule)) from error
            if len(text) > MAX_LINE_CHARACTERS or (len(raw) > MAX_LINE_CHARACTERS and not raw.endswith(b"\n")):
                rule = f"must be at most {MAX_LINE_CHARACTERS} characters"
                raise TraceError(where(self.path, number, text, rule))
            if text:
                yield Line(self.path, number, text)

    def _take(self, count: int, line: int, whole_line: bool) -> bytes:
        try:
            data = self._stream.readline(count) if whole_line else self._stream.read(count)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise TraceError(where(self.path, line, None, f"gzip data damaged or cut off ({error})")) from error
        except OSError as error:
            raise TraceError(where(self.path, line, None, f"cannot be read: {error.strerror or error}")) from error
        first = self._read_bytes == 0
        self._read_bytes += len(data)
        if self._read_bytes > MAX_TEXT_BYTES:
            raise TraceError(where(self.path, line, None, f"more than {MAX_TEXT_BYTES} bytes of text: must be less"))
        if first and data.startswith(_BYTE_ORDER_MARK):
            # Some editors put it in front. It is no part of the text; a file of nothing else counts as a
            # blank line.
            return data.removeprefix(_BYTE_ORDER_MARK) or b"\n"
        return data

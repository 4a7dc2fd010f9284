"""Text files: written whole or not at all; from outside read with suspicion: plain, gzip or a zip's member, bounded
in size and line length, errors with a line number.

Every reader of this package gets its lines here, so that a directory, a cut-off download, a binary file or a
compression bomb ends in the same clear `TraceError` whatever the format. What is beyond these limits is refused:
4 GiB of text after decompression, 10**7 lines (Mahimahi, which is read in blocks, has no limit of lines of bare
numbers), 4096 characters a line, and in JSON, which is held as a whole, 16 MiB.
"""

from __future__ import annotations

import gzip
import io
import re
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import IO, Final, NamedTuple

from bufgym.errors import TraceError, where
from bufgym.files import replaced
from bufgym.traces.archives import DAMAGED, ZIP_MAGIC, open_member, split_member

StrPath = str | PathLike[str]

# Text after decompression; reading stops as soon as it is passed.
MAX_TEXT_BYTES: Final = 4 * 2**30
MAX_LINE_CHARACTERS: Final = 4096
MAX_LINES: Final = 10**7
MAX_JSON_BYTES: Final = 16 * 2**20

_GZIP_MAGIC = b"\x1f\x8b"
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_PIECE_BYTES = 2**20
# What int() and float() take is wider than what a data file should hold ("1_000", "infinity", digits of
# other scripts).
_WHOLE = re.compile(r"[0-9]+")
_NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
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
    """A text file opened for one pass: plain, gzip or zip (told by its first bytes, whatever its name).

    Use as a context manager, and then one of `lines`, `first`, `text` and `read`.

    Raises:
        TraceError: missing, not a regular file, unreadable, damaged or cut-off gzip or zip, more than
            MAX_TEXT_BYTES; a zip of several members of which none is named (as in `archive.zip:member`).
    """

    def __init__(self, path: StrPath) -> None:
        self.path = path
        self._read_bytes = 0
        self._packing = "plain"

    def __enter__(self) -> TextFile:
        with ExitStack() as opened:
            try:
                file, member = split_member(self.path)
                raw = opened.enter_context(_open(self.path, file))
                magic = raw.peek(4)[:4]
                if magic.startswith(ZIP_MAGIC):
                    self._packing = "zip"
                    stream: IO[bytes] = opened.enter_context(io.BufferedReader(open_member(self.path, raw, member)))
                elif member is not None:
                    raise TraceError(where(self.path, None, None, f"{file} is no zip archive: cannot have members"))
                elif magic.startswith(_GZIP_MAGIC):
                    self._packing = "gzip"
                    stream = opened.enter_context(io.BufferedReader(gzip.GzipFile(fileobj=raw)))
                else:
                    stream = raw
            except OSError as error:
                raise TraceError(where(self.path, None, None, _reason(error, "opened"))) from error
            self._stream = stream
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._opened.close()

    def read(self, count: int, line: int) -> bytes:
        """Up to `count` bytes, empty at the end; `line` is the number that an error message gives."""
        return self._take(count, line, whole_line=False)

    def lines(self) -> Iterator[Line]:
        """The lines that are not blank, numbered from 1, without surrounding white space.

        Raises:
            TraceError: additionally a line over MAX_LINE_CHARACTERS, or one that is not UTF-8, or more than
                MAX_LINES lines, blank ones too.
        """
        number = 0
        while raw := self._raw_line(number + 1):
            number += 1
            if number > MAX_LINES:
                raise TraceError(where(self.path, number, None, f"more than {MAX_LINES} lines: must be fewer"))
            text = decoded(self.path, number, raw).strip()
            if len(text) > MAX_LINE_CHARACTERS or (len(raw) > MAX_LINE_CHARACTERS and not raw.endswith(b"\n")):
                rule = f"must be at most {MAX_LINE_CHARACTERS} characters"
                raise TraceError(where(self.path, number, text, rule))
            if text:
                yield Line(self.path, number, text)

    def first(self) -> Line | None:
        """The first line that is not blank, None in an empty file; of JSON, which may be a single line of any
        length, only its opening bracket.
        """
        number = 0
        while (raw := self._raw_line(number + 1)) and not raw.strip():
            number += 1
            if number > MAX_LINES:
                raise TraceError(where(self.path, number, None, f"more than {MAX_LINES} blank lines: must be fewer"))
        number += 1
        bracket = raw.lstrip()[:1]
        if bracket in (b"[", b"{"):
            return Line(self.path, number, bracket.decode())
        text = decoded(self.path, number, raw).strip()
        if len(text) > MAX_LINE_CHARACTERS:
            rule = f"must be at most {MAX_LINE_CHARACTERS} characters"
            raise TraceError(where(self.path, number, text, rule))
        return Line(self.path, number, text) if text else None

    def text(self, most: int = MAX_JSON_BYTES) -> str:
        """All of it, `most` bytes at the most.

        Raises:
            TraceError: additionally longer than `most`, or not UTF-8.
        """
        pieces: list[bytes] = []
        size = lines = 0
        while data := self._take(_PIECE_BYTES, lines + 1, whole_line=False):
            pieces.append(data)
            size += len(data)
            lines += data.count(b"\n")
            if size > most:
                raise TraceError(where(self.path, lines + 1, None, f"more than {most} bytes of JSON: must be at most"))
        raw = b"".join(pieces)
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            number = raw.count(b"\n", 0, error.start) + 1
            value = raw[error.start : error.start + 20]
            raise TraceError(where(self.path, number, value, "must be UTF-8 text")) from error

    def _raw_line(self, number: int) -> bytes:
        # Two more than the limit, so that a line just as long still comes with its end ("\r\n").
        return self._take(MAX_LINE_CHARACTERS + 2, number, whole_line=True)

    def _take(self, count: int, line: int, whole_line: bool) -> bytes:
        try:
            data = self._stream.readline(count) if whole_line else self._stream.read(count)
        except DAMAGED as error:
            rule = f"{self._packing} data damaged or cut off ({error})"
            raise TraceError(where(self.path, line, None, rule)) from error
        except OSError as error:
            raise TraceError(where(self.path, line, None, _reason(error, "read"))) from error
        first = self._read_bytes == 0
        self._read_bytes += len(data)
        if self._read_bytes > MAX_TEXT_BYTES:
            raise TraceError(where(self.path, line, None, f"more than {MAX_TEXT_BYTES} bytes of text: must be less"))
        if first and data.startswith(_BYTE_ORDER_MARK):
            # Some editors put it in front. It is no part of the text; a file of nothing else counts as a
            # blank line.
            return data.removeprefix(_BYTE_ORDER_MARK) or b"\n"
        return data


def decoded(path: StrPath, number: int, raw: bytes) -> str:
    """A line of bytes as text.

    Raises:
        TraceError: it is not UTF-8.
    """
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        rule = f"must be UTF-8 text (byte {error.start + 1} is not)"
        raise TraceError(where(path, number, raw[:60], rule)) from error


def write_text(path: StrPath, *parts: Iterable[str]) -> None:
    """Write all parts, one after the other, as UTF-8; or no file at all.

    Raises:
        TraceError: it cannot be written.
    """
    try:
        with replaced(Path(path)) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
            for part in parts:
                file.writelines(part)
    except OSError as error:
        raise TraceError(where(path, None, None, _reason(error, "written"))) from error


def _open(path: StrPath, file: Path) -> io.BufferedReader:
    if file.is_dir():
        raise TraceError(where(path, None, None, "is a directory: must be a file"))
    if not file.exists():
        raise TraceError(where(path, None, None, "no such file"))
    if not file.is_file():
        raise TraceError(where(path, None, None, "must be a regular file"))
    return file.open("rb")


def _reason(error: OSError, what: str) -> str:
    return f"cannot be {what}: {error.strerror or error}"

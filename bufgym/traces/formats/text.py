"""Text files, written completely or not at all, and read with bounds: plain or packed.

Every reader gets its lines from here, so that a directory, a truncated download, a binary file or a compression bomb
ends in the same clear `TraceError` whatever the format. The limits are 4 GiB of text after decompression, 2 * 10**7
lines, 4096 characters a line, and for what is held as a whole 16 MiB of JSON and 128 MiB of Mahimahi's numbers.
"""

import io
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from bufgym.traces.formats.faults import StrPath, fault, os_errors
from bufgym.traces.formats.packed import HEAD_BYTES, Unpacking, archive, packing
from bufgym.utils.errors import TraceError
from bufgym.utils.files import replaced, unpacked_limit
from bufgym.utils.libraries import missing

# Text after decompression; reading stops as soon as there is more.
MAX_TEXT_BYTES: Final = 4 * 2**30
MAX_LINE_CHARACTERS: Final = 4096
MAX_LINES: Final = 2 * 10**7  # 24 h of poses at 200 Hz are 17 million
MAX_JSON_BYTES: Final = 16 * 2**20

_BLOCK_BYTES: Final = 2**22

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
# int() and float() accept more than a data file should hold: "1_000", "infinity", digits of other scripts.
_WHOLE = re.compile(r"[0-9]+")
NUMBER: Final = r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"  # Pattern of a plain finite decimal number
_NUMBER = re.compile(NUMBER)
_NO_JSON: Final = re.compile(rb"\[ *(?:ID|SUM|[0-9]+)\] +\S")
_MILLISECONDS = re.compile(r"([0-9]+)(?:\.([0-9]{1,3})0*)?")


def split_cells(text: str) -> list[str]:
    """The cells between commas, without white space around them; a comma at the end of the line begins no cell."""
    return [cell.strip() for cell in text.strip().removesuffix(",").split(",")]


def decimals(number: int, places: int) -> str:
    """A whole number over 10**places, without needless decimals: 840500 with 3 is "840.5"."""
    whole, rest = divmod(number, 10**places)
    return f"{whole}.{rest:0{places}d}".rstrip("0") if rest else f"{whole}"


def is_header(text: str, header: str) -> bool:
    """Whether a line is that header of comma-separated names, whatever blanks are around the names."""
    return ",".join(split_cells(text)) == header


class Line(NamedTuple):
    """A line of a file, with methods that parse its cells.

    Each method raises a TraceError that names file, line, value and rule.
    """

    path: StrPath  # the file
    number: int  # of the line, counted from 1; 0 if `path` names the place
    text: str  # of the line, without surrounding white space

    def error(self, value: object | None, rule: str, field: str | None = None) -> TraceError:
        """The error to raise about this line."""
        return fault(self.path, rule, line=self.number or None, value=value, field=field)

    def misfit(self, rule: str) -> TraceError:
        """The error of a line that breaks the ``rule`` for its cells."""
        if ";" in self.text:
            rule = 'has ";" between cells, as files with decimal commas have: must have "," there and decimal points'
        return self.error(self.text, rule)

    def columns(self, count: int, separator: Literal[","] | None = None) -> list[str]:
        """The line's cells; there must be `count`; separated by white space unless by commas.

        One more comma at the end of the line begins no cell.
        """
        cells = [cell.strip() for cell in self.text.split(separator)]
        if separator and len(cells) == count + 1 and not cells[-1]:
            cells.pop()
        if len(cells) != count:
            raise self.misfit(f"must have {count} columns, has {len(cells)}")
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


@contextmanager
def open_text(path: StrPath) -> Iterator["TextFile"]:
    """Open a text file for one pass: plain or packed, recognised by its first bytes whatever its name."""
    with os_errors(path, "opened"):
        raw = _open(path)
    with raw:
        kind, most_bytes = packing(raw.peek(HEAD_BYTES)), unpacked_limit(os.fstat(raw.fileno()).st_size)
        stream: io.BufferedReader[Any] = io.BufferedReader(Unpacking(raw, kind), _BLOCK_BYTES) if kind else raw
        file = TextFile(path, stream, min(MAX_TEXT_BYTES, most_bytes), kind)
        file.check_no_archive()
        yield file


class TextFile:
    """An open text file. Use one of `lines`, `first`, `text` and `whole`; all of them respect the module's limits."""

    def __init__(
        self, path: StrPath, stream: "io.BufferedReader[Any]", most_bytes: int = MAX_TEXT_BYTES, packing: str = ""
    ) -> None:
        """Take the file's name, for error messages, and its bytes after decompression, at most ``most_bytes``."""
        self.path, self._stream, self._most_bytes, self._packing = path, stream, most_bytes, packing
        self._read_bytes = 0

    def check_no_archive(self) -> None:
        """Refuse a file that holds others, by its first bytes."""
        with self._damage(1):
            words = archive(str(self.path), self._stream.peek(HEAD_BYTES))
        if words:
            raise fault(self.path, words)

    @contextmanager
    def _damage(self, line: int) -> Iterator[None]:
        try:
            yield
        except EOFError as error:
            raise fault(self.path, f"{self._packing} data damaged or cut off ({error})", line=line) from error
        except ModuleNotFoundError as error:
            raise missing(f"{self.path}: reading zstd", error.name, "ros") from None
        except OSError as error:
            raise fault(self.path, f"cannot be read: {error.strerror or error}", line=line) from error

    def lines(self) -> Iterator[Line]:
        """The lines that are not blank, numbered from 1, without surrounding white space."""
        for number, block in self.blocks():
            yield from self.block_lines(number, block)

    def blocks(self) -> Iterator[tuple[int, bytes]]:
        """All lines in blocks of some MB, each with the number of its first line; see `block_lines`."""
        number, rest = 1, b""
        while data := self._take(_BLOCK_BYTES, number):
            cut = data.rfind(b"\n") + 1
            if cut:
                yield number, rest + data[:cut]
                number += (rest + data[:cut]).count(b"\n")
            rest = data[cut:] if cut else rest + data
            if len(rest) > MAX_LINE_CHARACTERS + 2:
                raise _too_long(_parsed_line(self.path, number, rest[: MAX_LINE_CHARACTERS + 2]))
            self._count(number - 1)
        if rest:
            self._count(number)
            yield number, rest

    def block_lines(self, number: int, block: bytes) -> Iterator[Line]:
        """The lines of a block that are not blank; `number` is that of its first line."""
        for k, raw in enumerate(block.split(b"\n"), number):
            line = _parsed_line(self.path, k, raw)
            if line.text:
                yield line

    def _count(self, number: int) -> None:
        if number > MAX_LINES:
            raise fault(self.path, f"more than {MAX_LINES} lines: must be fewer", line=MAX_LINES + 1)

    def below_header(self, header: str, fits: Callable[[str], object]) -> tuple[Line, Iterator[Line]]:
        """The first line, which must be that ``header`` (in words), and the lines below it."""
        lines = self.lines()
        first = next(lines, None)
        if first is None:
            raise fault(self.path, f"is empty: must begin with {header}")
        if not fits(first.text):
            raise first.misfit(f"must be {header}")
        return first, lines

    def first(self) -> Line | None:
        """The first line that is not blank, None in an empty file.

        JSON may be a single line of any length, so only its opening bracket is returned; iperf's text begins with one.
        """
        with self._damage(1):
            head = self._stream.peek(HEAD_BYTES).removeprefix(_BYTE_ORDER_MARK)
        start = head.lstrip()
        if start[:1] in (b"[", b"{") and not _NO_JSON.match(start):
            return Line(self.path, 1 + head[: len(head) - len(start)].count(b"\n"), start[:1].decode())
        return next(self.lines(), None)

    def whole(self, most: int) -> bytes:
        """All of it, at most `most` bytes."""
        content = self._take(most + 1, 1)
        if len(content) > most:
            raise fault(self.path, f"more than {most} bytes: must be at most")
        return content

    def text(self) -> str:
        """All of it, at most MAX_JSON_BYTES."""
        content = self.whole(MAX_JSON_BYTES)
        try:
            return content.decode("utf-8")
        except UnicodeDecodeError as error:
            line = content.count(b"\n", 0, error.start) + 1
            value = content[error.start : error.start + 20]
            raise fault(self.path, "must be UTF-8 text", line=line, value=value) from error

    def _take(self, count: int, line: int) -> bytes:
        with self._damage(line):
            data = self._stream.read(count)
        is_start = self._read_bytes == 0
        self._read_bytes += len(data)
        if self._read_bytes > self._most_bytes:
            raise fault(self.path, f"more than {self._most_bytes} bytes of text: must be less", line=line)
        if is_start and data.startswith(_BYTE_ORDER_MARK):
            # Some editors write it. It is no part of the text; a file of nothing else counts as a blank line.
            return data.removeprefix(_BYTE_ORDER_MARK) or b"\n"
        return data


def _parsed_line(path: StrPath, number: int, raw: bytes) -> Line:
    """A line of bytes as text."""
    try:
        line = Line(path, number, raw.decode("utf-8").strip())
    except UnicodeDecodeError as error:
        rule = f"must be UTF-8 text (byte {error.start + 1} is not)"
        raise fault(path, rule, line=number, value=raw[:60]) from error
    if len(line.text) > MAX_LINE_CHARACTERS:
        raise _too_long(line)
    return line


def write_text(path: StrPath, *parts: Iterable[str]) -> None:
    """Write all parts, one after the other, as UTF-8; or no file at all."""
    with (
        os_errors(path, "written"),
        replaced(Path(path)) as temporary,
        temporary.open("w", encoding="utf-8", newline="\n") as file,
    ):
        for part in parts:
            file.writelines(part)


def _too_long(line: Line) -> TraceError:
    return line.error(line.text, f"must be at most {MAX_LINE_CHARACTERS} characters")


def _open(path: StrPath) -> io.BufferedReader:
    file = Path(path)
    if file.is_dir():
        raise fault(path, "is a directory: must be a file")
    if not file.exists():
        raise fault(path, "no such file")
    if not file.is_file():
        raise fault(path, "must be a regular file")
    return file.open("rb")

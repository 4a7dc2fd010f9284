"""Files packed as a whole, recognised by their first bytes: gzip, bzip2, xz and zstd are read, archives are named."""

import bz2
import functools
import gzip
import io
import lzma
import zlib
from collections.abc import Callable, Iterator
from typing import IO, Any, Final

PACKINGS: Final = {"zstd": b"\x28\xb5\x2f\xfd", "gzip": b"\x1f\x8b", "bzip2": b"BZh", "xz": b"\xfd7zXZ\0"}
UNPACKERS: Final = {"zstd": "zstd -d", "gzip": "gunzip", "bzip2": "bunzip2", "xz": "unxz"}
ENDINGS: Final = (".zstd", ".zst", ".gz", ".bz2", ".xz")

_ARCHIVES: Final = {b"PK\x03\x04": "a zip archive", b"7z\xbc\xaf\x27\x1c": "a 7z archive", b"Rar!": "a rar archive"}
_TAR_AT: Final = 257  # where "ustar" stands in a tar archive
_PIECE_BYTES: Final = 2**20
_MOST_WINDOW_BYTES: Final = 2**27  # what zstd and xz may hold of the text before

HEAD_BYTES: Final = _TAR_AT + 5
"""How many first bytes tell an archive."""


def packing(head: bytes) -> str:
    """How a file with these first bytes is packed; empty if it is not."""
    return next((name for name, magic in PACKINGS.items() if head.startswith(magic)), "")


def archive(name: str, head: bytes) -> str:
    """What a file of this name with these first bytes is that holds other files, in words; empty for other files."""
    if head.startswith(b"PK\x03\x04") and (name.lower().endswith((".xlsx", ".ods")) or b"[Content_Types]" in head):
        return "is a spreadsheet: must be saved as CSV first"
    kind = "a tar archive" if head[_TAR_AT:].startswith(b"ustar") else ""
    kind = kind or next((words for magic, words in _ARCHIVES.items() if head.startswith(magic)), "")
    return kind and f"is {kind}: must be unpacked first"


def without_ending(name: str) -> str:
    """A file's name without the ending of its packing."""
    return next((name.removesuffix(ending) for ending in ENDINGS if name.endswith(ending)), name)


def pieces(file: IO[bytes], kind: str) -> Iterator[bytes]:
    """What a packed file holds, in pieces of some MB; EOFError where it is damaged or cut off."""
    if kind == "zstd":
        yield from _unzstd(file)
        return
    try:
        if kind == "gzip":
            with gzip.GzipFile(fileobj=file) as stream:
                while piece := stream.read(_PIECE_BYTES):
                    yield piece
        else:
            yield from _in_turn(
                file,
                bz2.BZ2Decompressor if kind == "bzip2" else functools.partial(lzma.LZMADecompressor, memlimit=2**28),
            )
    except (zlib.error, lzma.LZMAError, gzip.BadGzipFile) as error:
        raise EOFError(str(error)) from error


def _in_turn(file: IO[bytes], make: Callable[[], Any]) -> Iterator[bytes]:
    """The content of streams of bzip2 or xz that follow each other."""
    decompressor, rest = make(), b""
    while True:
        if decompressor.eof:
            rest = (decompressor.unused_data or file.read(_PIECE_BYTES)).lstrip(b"\0")
            if not rest:
                return
            decompressor = make()
        elif decompressor.needs_input and not (rest := file.read(_PIECE_BYTES)):
            raise EOFError("ends early")
        try:
            piece, rest = decompressor.decompress(rest, _PIECE_BYTES), b""
        except OSError as error:  # bzip2's word for damage
            raise EOFError(str(error)) from error
        if piece:
            yield piece


def _unzstd(file: IO[bytes]) -> Iterator[bytes]:
    """The content of zstd; EOFError where less comes out than the data say."""
    import zstandard

    says = zstandard.frame_content_size(file.read(18))  # a frame's header is no longer; -1 where it does not say
    file.seek(0)
    decompressor = zstandard.ZstdDecompressor(max_window_size=_MOST_WINDOW_BYTES)
    try:
        with decompressor.stream_reader(file, read_across_frames=True, closefd=False) as reader:
            while piece := reader.read(_PIECE_BYTES):
                says -= len(piece)
                yield piece
    except zstandard.ZstdError as error:
        raise EOFError(str(error)) from error
    if says > 0:
        raise EOFError(f"zstd data end {says} bytes early")


def unzstd(packed: bytes, most_bytes: int) -> bytes:
    """Decompress to at most a piece more than ``most_bytes``."""
    data = bytearray()
    for piece in _unzstd(io.BytesIO(packed)):
        data += piece
        if len(data) > most_bytes:
            break
    return bytes(data)


class Unpacking(io.RawIOBase):
    """A packed file as a stream of its content."""

    def __init__(self, file: IO[bytes], kind: str) -> None:
        self._pieces, self._piece = pieces(file, kind), memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self._piece:
            piece = next(self._pieces, None)
            if piece is None:
                return 0
            self._piece = memoryview(piece)
        count = min(len(buffer), len(self._piece))
        buffer[:count] = self._piece[:count]
        self._piece = self._piece[count:]
        return count

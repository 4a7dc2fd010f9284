"""Files: written whole or not at all, read with size limits, and found where bufgym ships them."""

import os
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bufgym.utils.errors import BufgymError, unknown, where

PACKAGE = Path(__file__).resolve().parents[1]

FREELY_UNPACKED_BYTES = 64 * 2**20
MOST_UNPACKED = 100
"""Largest ratio of unpacked to packed bytes. No recording or text data set packs so well; a bomb packs 1,000:1."""

MAX_TOML_BYTES = 2**18  # Limit for a TOML file: a client of a thousand topics needs less
MAX_DOTS = 100  # Most dots in one line of a TOML file


def read_whole(path: str | os.PathLike[str], most_bytes: int) -> bytes:
    """Read all bytes of a regular file that has at most ``most_bytes``.

    Raises BufgymError: missing, a folder, a device, a FIFO, larger.
    """
    source = Path(path)
    try:
        if source.exists() and not source.is_file():
            raise BufgymError(f"{path}: must be a regular file")
        with source.open("rb") as file:
            data = file.read(most_bytes + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, BufgymError):
            raise
        reason = getattr(error, "strerror", None) or error
        why = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read: {reason}"
        raise BufgymError(f"{path}: {why}") from None
    if len(data) > most_bytes:
        raise BufgymError(f"{path}: larger than {most_bytes} bytes: must be at most that")
    return data


def read_utf8(path: str | os.PathLike[str], most_bytes: int) -> str:
    """Read the UTF-8 text of such a file; raise a BufgymError for other encodings."""
    try:
        return read_whole(path, most_bytes).decode("utf-8")
    except UnicodeDecodeError:
        raise BufgymError(f"{path}: must be UTF-8 text") from None


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file."""
    text = read_utf8(path, MAX_TOML_BYTES)
    for number, line in enumerate(text.split("\n"), 1):
        # The parser's memory grows with the square of a dotted key's parts.
        if line.count(".") > MAX_DOTS:
            raise BufgymError(where(path, number, None, f"must have at most {MAX_DOTS} dots"))
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise BufgymError(f"{path}: nested too deep") from None
    except ValueError as error:  # from tomllib, or from int() for thousands of digits
        raise BufgymError(f"{path}: {str(error).partition(';')[0]}") from None


def check_keys(table: Mapping[str, Any], known: set[str], first: str = "") -> None:
    """Check that every key of the table is known; the message names ``first`` before the known keys."""
    for key in sorted(set(table) - known):
        raise unknown("key", key, [*filter(None, first.split(", ")), *sorted(known)])


def unpacked_limit(packed_bytes: int) -> int:
    """Most bytes that so many packed bytes may unpack to."""
    return FREELY_UNPACKED_BYTES + MOST_UNPACKED * packed_bytes


@contextmanager
def replaced(target: Path) -> Iterator[Path]:
    """Yield a temporary file beside ``target``, which replaces the target if the block ends without an error.

    An OSError that names no file, such as that of a full disk, then names the target.
    """
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes a file that only its owner may read; a result should be as readable as any other new file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        os.replace(temporary, target)
    except OSError as error:
        if error.filename is None:
            error.filename = str(target)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(target: Path, text: str) -> Path:
    """Write a file of UTF-8, whole or not at all; return its path."""
    with replaced(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return target


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock ``folder`` for this process while the block runs; the lock ends with the process.

    Raises BufgymError: another process holds it.
    """
    from filelock import FileLock, Timeout

    file = folder / ".lock"
    lock = FileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        rule = "wait until it has ended, or choose another folder"
        raise BufgymError(f"{folder}: another process is writing there; {rule}") from None
    except PermissionError:  # nobody else can write there either
        yield
        return
    try:
        yield
    finally:
        file.unlink(missing_ok=True)
        lock.release()


def shipped(inside: str, checkout: str, pattern: str) -> dict[str, Path]:
    """Stem -> path of the files that come with bufgym; empty if there are none.

    A wheel carries them inside the package, in ``bufgym/data/<inside>``; a checkout has them in ``<checkout>``.
    """
    for folder in (PACKAGE / "data" / inside, PACKAGE.parent / checkout):
        # A folder with an __init__.py is another package of that name, next to an installed bufgym.
        if folder.is_dir() and not (folder / "__init__.py").exists():
            files = sorted(folder.glob(pattern))
            if files:
                return {path.stem: path for path in files}
    return {}

"""Which files a recording has, in which order and how they are packed.

A recording is one file, or a rosbag2 folder. A folder has the files that its ``metadata.yaml`` names, in that order,
and no others. A folder without it, as a recorder leaves it that was killed, has all its ``.mcap`` and ``.db3`` files in
order of time, which a warning says. Untrusted YAML can be nested so deep that its parser crashes, so its depth is
measured first.

What a file holds is told from its first bytes. One that was packed as a whole (``.zstd``, ``.gz``) is read from an
unpacked copy. A SQLite file with a journal beside it (``-wal``, ``-journal``) is read from a copy of both, because
SQLite changes both when it reads them, and without the journal messages would be missing.
"""

import filecmp
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Final

from bufgym.traces.formats import bag_files
from bufgym.traces.formats.bag_files import SOURCES, Message, RefusedError, Unpacked, journals
from bufgym.traces.formats.faults import StrPath, fault, os_errors, warn
from bufgym.traces.formats.packed import (
    ENDINGS,
    HEAD_BYTES,
    PACKINGS,
    UNPACKERS,
    packing,
    pieces,
    unzstd,
    without_ending,
)
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import read_utf8
from bufgym.utils.libraries import library, missing

MAX_METADATA_BYTES: Final = 2**23

_RULE: Final = "must be an MCAP file, a ROS 1 bag, or a rosbag2 folder or .db3 file"
_MAGICS: Final = {bag_files.MCAP_MAGIC: "mcap", b"#ROSBAG V": "ros1", b"SQLite format 3\0": "rosbag2"}
_METADATA: Final = "metadata.yaml"
_INFORMATION: Final = "rosbag2_bagfile_information"
_ENDINGS: Final = tuple(f"{kind}{end}" for kind in (".mcap", ".db3", ".bag") for end in ("", *ENDINGS))
_STORAGES: Final = {"sqlite3": "rosbag2", "mcap": "mcap"}
_NONE: Final = ("", "none", "null", "~")  # of a compression, in small letters
_MOST_NESTED: Final = 50  # ROS 2 writes six levels
_LISTED_FILES: Final = 20  # A warning names no more
_LISTED_SEAMS: Final = 3
_SEAM_NS: Final = 10**9  # From the end of a file to the beginning of the next: a recorder that splits takes less
_FIXES: Final = {
    "mcap": "`mcap recover {0} -o sound.mcap`",
    "ros1": "`rosbag reindex {0}`",
    "rosbag2": "`sqlite3 {0} .recover | sqlite3 sound.db3`",
}


@dataclass(frozen=True)
class Split:
    """One file of a recording."""

    path: Path
    kind: str  # "mcap", "ros1", "rosbag2", or "" for anything else
    packed: str = ""  # as a whole: "zstd", "gzip", ...; empty if it is not
    by_message: bool = False  # each of its messages is packed in zstd, as the folder's metadata says


def is_recording(source: StrPath) -> bool:
    """Whether this is a recording, by its first bytes (a folder: by its content), whatever its name."""
    path = Path(source)
    with os_errors(path, "opened"):
        if path.is_dir():
            return (path / _METADATA).is_file() or any(file.name.endswith(_ENDINGS) for file in path.iterdir())
        return path.is_file() and _split(path).kind != ""


def refuse_recording(path: StrPath, rule: str) -> None:
    """Raise an error if this is a recording, which must be something else by this rule."""
    if is_recording(path):
        raise fault(path, f"is a recording of messages, whose topics `bufgym trace from-bag` lists: {rule}")


def splits(path: StrPath | Sequence[StrPath]) -> list[Split]:
    """The files of a recording, or of several of one kind that are read as one, in the order of reading."""
    if not isinstance(path, str | PathLike):
        files = [split for one in path for split in splits(one)]
        for split in files:
            _check_kind(split, files[0])
        return sorted(files, key=_begins_ns) if len(path) > 1 else files
    path = Path(path)
    if not path.exists() or not is_recording(path):
        raise fault(path, _RULE if path.exists() else "no such file")
    if not path.is_dir():
        return [_split(path)]
    with os_errors(path, "read"):
        return _listed(path) if (path / _METADATA).is_file() else _unlisted(path)


def split_messages(files: list[Split], types: dict[str, str]) -> Iterator[tuple[Path, Message]]:
    """Every message of a recording's files, with the file that it is in; adds every topic to ``types``."""
    with os_errors(files[0].path, "read"):
        unpacked = Unpacked(sum(split.path.stat().st_size for split in files))
    for split in files:
        for message in _sound(split, types, unpacked):
            yield split.path, message


def _sound(split: Split, types: dict[str, str], unpacked: Unpacked) -> Generator[Message]:
    """Every message of a file; an error about damage says how many are sound."""
    count, first_ns, last_ns = 0, 0, 0

    def sound() -> str:
        first = f"its first {count:,} messages ({abs(last_ns - first_ns) / 1e9:.3f} s) are sound; " if count else ""
        mend = _FIXES[split.kind].format(without_ending(split.path.name))
        unpack = f", once `{UNPACKERS[split.packed]}` has unpacked it" if split.packed else ""
        return f"; {first}{mend} saves what is sound{unpack}"

    with damage_errors(split.path, after=sound):
        for message in _messages(split, types, unpacked):
            last_ns = message[1]
            first_ns = first_ns if count else last_ns
            count += 1
            yield message


class Seams:
    """When the files of a recording begin and end."""

    def __init__(self) -> None:
        self._spans: list[tuple[Path, int, int]] = []  # file, first log time and last, ns

    def add(self, file: Path, logged_ns: int) -> None:
        """Add a message of this file; files come one after the other."""
        _, first_ns, last_ns = self._spans.pop() if self._spans and self._spans[-1][0] == file else ("", logged_ns, 0)
        self._spans.append((file, min(first_ns, logged_ns), max(last_ns, logged_ns)))

    def said(self, path: StrPath) -> None:
        """Warn of files between which there is a gap, and of those that overlap."""
        apart = [
            f"{two.name} begins {abs(first_ns - last_ns) / 1e9:.3f} s "
            f"{'after' if first_ns > last_ns else 'before'} the end of {one.name}"
            for (one, _, last_ns), (two, first_ns, _) in pairwise(self._spans)
            if abs(first_ns - last_ns) > _SEAM_NS
        ]
        if apart:
            more = f"; so do {len(apart) - _LISTED_SEAMS} more" if len(apart) > _LISTED_SEAMS else ""
            warn(path, "; ".join(apart[:_LISTED_SEAMS]) + more)


@contextmanager
def damage_errors(path: Path, before: str = "", after: Callable[[], str] = str) -> Iterator[None]:
    """Turn whatever the libraries raise on a damaged file into one error that names the file."""
    try:
        yield
    except (BufgymError, Warning):
        raise
    except ModuleNotFoundError as error:
        raise missing(f"{path}: reading recordings", error.name, "ros") from None
    except RefusedError as error:
        raise fault(path, str(error)) from error
    except Exception as error:
        # Parsers of binary formats raise nearly anything on bytes that are not what they should be.
        words = " ".join(str(error).split()) or "no more data"
        raise fault(path, f"{before}cut off or damaged: {type(error).__name__}: {words[:160]}{after()}") from error


def _messages(split: Split, types: dict[str, str], unpacked: Unpacked) -> Iterator[Message]:
    with tempfile.TemporaryDirectory() as scratch:
        path, doubt = _readable(split, Path(scratch), unpacked), partial(warn, split.path)
        for channel, logged_ns, data in SOURCES[split.kind](path, types, doubt):
            is_packed = data.startswith(PACKINGS["zstd"])
            # CDR begins with a zero, so a message in it is told from a packed one without metadata.
            if channel.encoding == "cdr" and split.by_message and not is_packed and data[:1] != b"\0":
                raise ValueError(f"a message on {channel.topic} that is neither CDR nor packed in zstd")
            if is_packed and (split.by_message or channel.encoding == "cdr"):
                most = bag_files.MAX_CHUNK_BYTES
                data = unzstd(data, most)
                if len(data) > most:
                    raise RefusedError(f"a message of more than {most} bytes: must be at most that")
                unpacked.add(len(data))
            yield channel, logged_ns, data


def _readable(split: Split, scratch: Path, unpacked: Unpacked) -> Path:
    """The file itself, or a copy in ``scratch`` where it is packed or has a journal."""
    copy = scratch / "copy"
    if split.packed:
        with split.path.open("rb") as file, copy.open("wb") as out:
            for piece in pieces(file, split.packed):
                unpacked.add(len(piece))
                out.write(piece)
        return copy
    real = split.path.resolve()  # SQLite looks for the journal there
    endings = journals(real) if split.kind == "rosbag2" else []
    if not endings:
        return split.path
    with os_errors(split.path, f"copied for reading together with its {' and '.join(endings)}"):
        for ending in ("", *endings):
            shutil.copyfile(f"{real}{ending}", f"{copy}{ending}")
    return copy


def _split(path: Path) -> Split:
    if not path.is_file():
        raise fault(path, "must be a regular file")
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
        packed = packing(head)
        if packed:
            file.seek(0)
            # Whoever reads another file as text says what is wrong with it.
            with damage_errors(path), suppress(*() if path.name.endswith(_ENDINGS) else (EOFError,)):
                head = next(pieces(file, packed), b"")
    return Split(path, next((kind for magic, kind in _MAGICS.items() if head.startswith(magic)), ""), packed)


def _listed(folder: Path) -> list[Split]:
    """The files that the folder's metadata names."""
    storage, names = _metadata(folder / _METADATA)
    mode, form = storage.get("compression_mode", "").lower(), storage.get("compression_format", "")
    if mode not in _NONE and form != "zstd":
        raise fault(folder / _METADATA, f"compression {form!r}: must be zstd")
    identifier = storage.get("storage_identifier", "")
    if identifier not in _STORAGES:
        raise fault(folder / _METADATA, f"storage {identifier!r}: must be {' or '.join(_STORAGES)}")
    if not names:
        raise fault(folder / _METADATA, "names no file: must list them as relative_file_paths (see `ros2 bag reindex`)")
    files = []
    for name in names:
        # Recorders pack a file when it is full, and people unpack it: it may lie there in either form.
        other = name.removesuffix(".zstd") if name.endswith(".zstd") else f"{name}.zstd"
        path = next((folder / one for one in (name, other) if (folder / one).exists()), None)
        if path is None:
            raise fault(folder / name, f"no such file, which {_METADATA} names: must be there, or left out of it")
        split = _split(path)
        if split.kind != _STORAGES[identifier]:
            raise fault(path, f"must be a file of {identifier}, as {_METADATA} says")
        files.append(Split(path, split.kind, split.packed, mode == "message"))
    return files


def _unlisted(folder: Path) -> list[Split]:
    """All files of the folder in order of time, each once."""
    files = sorted(path for path in folder.iterdir() if path.name.endswith(_ENDINGS) and path.name[0] != ".")
    files = [path for path in files if path.suffix not in ENDINGS or path.with_suffix("") not in files]
    by_size: dict[int, list[Path]] = {}
    copies: list[str] = []
    for path in files:
        alike = by_size.setdefault(path.stat().st_size, [])
        if any(filecmp.cmp(path, other, shallow=False) for other in alike):
            copies.append(path.name)
        else:
            alike.append(path)
    found = [_split(path) for alike in by_size.values() for path in alike]
    for split in found:
        if not split.kind:
            raise fault(split.path, "holds no recording: must be fixed, or left out of the folder")
        _check_kind(split, found[0])
    found.sort(key=_begins_ns)
    names = ", ".join(split.path.name for split in found[:_LISTED_FILES]) + ", ..." * (len(found) > _LISTED_FILES)
    left_out = f", without copies of them ({', '.join(copies)})" if copies else ""
    why = "" if found[0].kind == "ros1" else f"has no {_METADATA}, so "  # which ROS 1 does not write
    warn(folder, f"{why}its files are read in order of time: {names}{left_out}")
    return found


def _check_kind(split: Split, first: Split) -> None:
    if split.kind != first.kind:
        raise fault(split.path, f"must be a recording of the same storage as {first.path.name}")


def _begins_ns(split: Split) -> int:
    """Time of the file's first message, 0 if it has none."""
    with closing(_sound(split, {}, Unpacked(split.path.stat().st_size))) as messages:
        return next((logged_ns for _, logged_ns, _ in messages), 0)


def _metadata(path: Path) -> tuple[dict[str, str], list[str]]:
    """How the files are stored, and their names."""
    yaml = library("yaml", "ros", f"{path}: reading recordings")
    loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)  # all scalars are text; libyaml's is ten times as fast
    text, depth = read_utf8(path, MAX_METADATA_BYTES), 0
    try:
        for event in yaml.parse(text, loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _MOST_NESTED:
                raise fault(path, f"nested more than {_MOST_NESTED} deep: must be as ROS 2 writes it")
        content = yaml.load(text, loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = " ".join(str(getattr(error, "problem", None) or error).split())[:160]
        raise fault(path, f"must be YAML ({problem})", line=mark and mark.line + 1) from error
    about = content.get(_INFORMATION) if isinstance(content, dict) else None
    if not isinstance(about, dict):
        raise fault(path, f"must hold {_INFORMATION}, as ROS 2 writes it")
    names = about.get("relative_file_paths") or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise fault(path, "relative_file_paths must be a list of names")
    storage = {key: value if isinstance(value, str) else str(value) for key, value in about.items()}
    return storage, list(dict.fromkeys(Path(name).name for name in names))

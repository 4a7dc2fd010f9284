"""Public data sets in a cache folder: downloaded or copied from files, verified, unpacked.

Every file in the cache is complete and has the checksum that is known for it. A download in progress has a name of its
own (`.NAME.part`) and takes its place by one renaming. Each data set has a lock, so that one process fetches at a time;
the others wait and then find the files.

    <cache>/ucc-5g/5G-production-dataset.zip     as published
    <cache>/ucc-5g/5G-production-dataset/...     unpacked
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from bufgym.ground import files
from bufgym.ground.errors import BufgymError, where
from bufgym.traces.datasets.download import Patience, Progress, discard, disk, download, refuse_page
from bufgym.traces.datasets.table import Dataset, Remote, datasets
from bufgym.traces.datasets.unpack import ending, unpack
from bufgym.traces.formats.faults import StrPath

Origin = Literal["downloaded", "there already", "copied"]
Note: TypeAlias = Callable[[str], None]
"""Called with a sentence about what is being done."""
Watch: TypeAlias = Callable[[str], Progress]
"""Called with a file's name; returns what is called with the progress of its download."""


@dataclass(frozen=True)
class Fetched:
    """A file in the cache."""

    path: Path
    """Where it is."""
    sha256: str
    """Its checksum, computed from the file."""
    known: bool
    """Whether there was a known checksum to compare with."""
    origin: Origin
    """How it came into the cache."""
    unpacked: Path | None = None
    """The folder with its content, if it is an archive."""


def cache_folder() -> Path:
    """Where data sets are kept: `bufgym/datasets` in XDG_CACHE_HOME, or else in the platform's cache folder."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(named):  # the XDG specification says to ignore other values
        base = Path(named)
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path.home() / ".cache"
    return base / "bufgym" / "datasets"


def fetch_dataset(
    dataset: str | Dataset,
    to: StrPath | None = None,
    local_files: Sequence[StrPath] = (),
    *,
    note: Note | None = None,
    watch: Watch | None = None,
    patience: Patience | None = None,
) -> list[Fetched]:
    """Put a data set into `to`/NAME.

    Args:
        dataset: a name of `datasets()`, or a data set of your own.
        to: the folder for data sets, by default `cache_folder()`.
        local_files: files fetched by hand, recognised by name or checksum; if there are any, nothing is downloaded.
        note: called with what happens, in sentences.
        watch: called with the name of each file before its download, for a callback that reports the progress.
        patience: when to give up on a server.

    Returns:
        The files, in the order of the data set or of `local_files`.

    Raises:
        BufgymError: no such data set, a wrong checksum, an unknown address, or an error of `download` or `unpack`.
    """
    if isinstance(dataset, str):
        if dataset not in datasets():
            raise BufgymError(f"{dataset}: no such data set: must be one of {', '.join(datasets())}")
        dataset = datasets()[dataset]
    if not dataset.files and not local_files:
        raise BufgymError(
            f"{dataset.name}: the address of its files is not known: fetch them by hand from {dataset.page} and "
            f"name them with --from FILE"
        )
    note = note or (lambda sentence: None)
    root = cache_folder() if to is None else Path(to)
    folder = root / dataset.name
    with disk(folder):
        folder.mkdir(parents=True, exist_ok=True)
    waiting = f"waiting for another bufgym that fetches {dataset.name}"
    with _locked(root / f".{dataset.name}.lock", lambda: note(waiting)):
        if local_files:
            return [_copied(dataset, folder, Path(file)) for file in local_files]
        return [_downloaded(remote, folder, note, watch, patience) for remote in dataset.files]


# --- one file ---------------------------------------------------------------------------------------------------------


def _downloaded(remote: Remote, folder: Path, note: Note, watch: Watch | None, patience: Patience | None) -> Fetched:
    target = folder / remote.path
    if target.is_file():
        checksum = _sha256(target)
        if remote.sha256 in (None, checksum):
            return _settled(remote, target, checksum, "there already")
        note(f"{target}: changed since it was fetched: fetching it again")
    with disk(target):
        target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f".{target.name}.part")
    for may_retry in (True, False):
        resumed = part.exists()
        download(remote.address, part, watch(remote.path) if watch is not None else None, patience)
        checksum = _sha256(part)
        if remote.sha256 in (None, checksum):
            break
        discard(part)
        if not (resumed and may_retry):
            raise _wrong(remote.address, checksum, remote.sha256)
        note(f"{remote.path}: the parts do not fit together: fetching it again")
    with disk(target):
        os.replace(part, target)
        discard(part)
    return _settled(remote, target, checksum, "downloaded")


def _copied(dataset: Dataset, folder: Path, file: Path) -> Fetched:
    """A file fetched by hand, copied into the cache under its published name."""
    if not file.is_file():
        raise BufgymError(f"{file}: no such file (--from)")
    with file.open("rb") as opened:
        refuse_page(file, opened.read(1024))
    checksum = _sha256(file)
    remote = _recognised(dataset, file, checksum)
    if remote.sha256 not in (None, checksum):
        raise _wrong(file, checksum, remote.sha256)
    target = folder / remote.path
    with disk(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with files.replaced(target) as copy:
            shutil.copyfile(file, copy)
            if _sha256(copy) != checksum:
                raise BufgymError(f"{file}: changed while it was copied")
    return _settled(remote, target, checksum, "copied")


def _recognised(dataset: Dataset, file: Path, checksum: str) -> Remote:
    """Which of the data set's files this is: by its checksum, by its name, or because there is only one."""
    for remote in dataset.files:
        if remote.sha256 == checksum:
            return remote
    for remote in dataset.files:
        if Path(remote.path).name == file.name or len(dataset.files) == 1:
            return remote
    if not dataset.files:
        return Remote(file.name, dataset.page)
    names = ", ".join([remote.path for remote in dataset.files[:3]] + ["..."] * (len(dataset.files) > 3))
    rule = f"no file of {dataset.name}, by its name or its checksum (sha256 {checksum}); its files: {names}"
    raise BufgymError(where(file, None, None, rule))


def _settled(remote: Remote, target: Path, checksum: str, origin: Origin) -> Fetched:
    """The file in its place, unpacked if it is an archive."""
    try:
        unpacked = _unpacked(target, renew=origin != "there already")
    except BufgymError:
        if remote.sha256 is None:
            # There is no checksum to verify this file with, so the next attempt must fetch it again.
            target.unlink()
        raise
    return Fetched(target, checksum, remote.sha256 is not None, origin, unpacked)


def _unpacked(archive: Path, renew: bool) -> Path | None:
    """The folder beside the archive with its content; None if it is no archive."""
    suffix = ending(archive.name)
    if suffix is None:
        return None
    folder = archive.with_name(archive.name[: -len(suffix)])
    if renew and folder.exists():
        # Renamed first, in one step, so that a half removed folder is never taken for a complete one.
        stale = folder.with_name(f".{folder.name}.stale")
        shutil.rmtree(stale, ignore_errors=True)
        with disk(folder):
            folder.rename(stale)
        shutil.rmtree(stale, ignore_errors=True)
    if not folder.exists():
        unpack(archive, folder)
    return folder


def _wrong(source: object, checksum: str, expected: str | None) -> BufgymError:
    return BufgymError(f"{source}: wrong checksum: sha256 is {checksum}, must be {expected}; not kept")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def _locked(lock: Path, waiting: Callable[[], None]) -> Iterator[None]:
    """Let one process in at a time; the system frees the lock of a process that dies."""
    with disk(lock):
        handle = lock.open("ab")
    with handle:
        if sys.platform == "win32":
            import msvcrt
            import time

            announced = False
            while True:
                try:
                    msvcrt.locking(handle.fileno(), msvcrt.LK_NBLCK, 1)
                    break
                except OSError:
                    if not announced:
                        waiting()
                    announced = True
                    time.sleep(0.2)
        else:
            import fcntl

            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                waiting()
                fcntl.flock(handle, fcntl.LOCK_EX)
        yield

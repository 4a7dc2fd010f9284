"""Public data sets in a cache folder: downloaded or taken from a file, verified, unpacked.

A file in the cache is whole, and has the checksum that is known for it, or it is not there: what is under way has a
name of its own (`.NAME.part`) and takes its place by one renaming. A lock a data set lets one process fetch at a time;
the others wait, and then find the files.

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

from bufgym import files
from bufgym.errors import BufgymError, where
from bufgym.traces.datasets import Dataset, Remote, datasets
from bufgym.traces.fetch_http import Patience, Progress, discard, disk, download, refuse_page
from bufgym.traces.fetch_unpack import ending, unpack
from bufgym.traces.files import StrPath

Origin = Literal["downloaded", "there already", "given"]
Note: TypeAlias = Callable[[str], None]
"""Hears, in a sentence, of what is being done."""
Watch: TypeAlias = Callable[[str], Progress]
"""Asked, with a file's name, for who watches its download."""


@dataclass(frozen=True)
class Fetched:
    """A file in the cache, its checksum as found, and how that compares: `known` if it is the one on record."""

    path: Path
    sha256: str
    known: bool
    origin: Origin
    unpacked: Path | None = None


def cache_folder() -> Path:
    """Where data sets are kept: `bufgym/datasets` in the platform's folder for caches (XDG_CACHE_HOME, if set)."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(named):  # the XDG specification: other values are to be ignored
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
    given: Sequence[StrPath] = (),
    *,
    note: Note | None = None,
    watch: Watch | None = None,
    patience: Patience | None = None,
) -> list[Fetched]:
    """Bring a data set into `to`/NAME.

    Args:
        dataset: a name of `datasets()`, or a data set of your own.
        to: the folder for data sets, by default `cache_folder()`.
        given: files that were fetched by hand; then nothing is downloaded. Each is known by its name or its checksum.
        note: told what happens.
        watch: asked for who hears of the bytes of a file that is about to be downloaded.
        patience: when to give up on a server.

    Returns:
        The files, in the data set's order or as given.

    Raises:
        BufgymError: no such data set, a wrong checksum, an unknown address, or what `download` and `unpack` say.
    """
    if isinstance(dataset, str):
        if dataset not in datasets():
            raise BufgymError(f"{dataset}: no such data set: must be one of {', '.join(datasets())}")
        dataset = datasets()[dataset]
    if not dataset.files and not given:
        raise BufgymError(
            f"{dataset.name}: the address of its files is not known: fetch them by hand from {dataset.page} and "
            f"give them with --from FILE"
        )
    note = note or (lambda sentence: None)
    root = cache_folder() if to is None else Path(to)
    folder = root / dataset.name
    with disk(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with _alone(
        root / f".{dataset.name}.lock", lambda: note(f"waiting for another bufgym that fetches {dataset.name}")
    ):
        if given:
            return [_take(dataset, folder, Path(file)) for file in given]
        return [_obtain(remote, folder, note, watch, patience) for remote in dataset.files]


# --- one file ---------------------------------------------------------------------------------------------------------


def _obtain(remote: Remote, folder: Path, note: Note, watch: Watch | None, patience: Patience | None) -> Fetched:
    target = folder / remote.path
    if target.is_file():
        found = _sha256(target)
        if remote.sha256 in (None, found):
            return _settled(remote, target, found, "there already")
        note(f"{target}: changed since it was fetched: fetching it anew")
    with disk(target):
        target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f".{target.name}.part")
    for again in (True, False):
        resumed = part.exists()
        download(remote.address, part, watch(remote.path) if watch is not None else None, patience)
        found = _sha256(part)
        if remote.sha256 in (None, found):
            break
        discard(part)
        if not (resumed and again):
            raise _wrong(remote.address, found, remote.sha256)
        note(f"{remote.path}: the parts do not fit together: fetching it anew")
    with disk(target):
        os.replace(part, target)
        discard(part)
    return _settled(remote, target, found, "downloaded")


def _take(dataset: Dataset, folder: Path, file: Path) -> Fetched:
    """A file fetched by hand, copied into the cache under its published name."""
    if not file.is_file():
        raise BufgymError(f"{file}: no such file (--from)")
    with file.open("rb") as opened:
        refuse_page(file, opened.read(1024))
    found = _sha256(file)
    remote = _which(dataset, file, found)
    if remote.sha256 not in (None, found):
        raise _wrong(file, found, remote.sha256)
    target = folder / remote.path
    with disk(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with files.replaced(target) as copy:
            shutil.copyfile(file, copy)
            copied = _sha256(copy)
            if copied != found:
                raise BufgymError(f"{file}: changed while it was copied")
    return _settled(remote, target, found, "given")


def _which(dataset: Dataset, file: Path, found: str) -> Remote:
    """Which of the data set's files this is: by its checksum, its name, or because there is but one."""
    for remote in dataset.files:
        if remote.sha256 == found:
            return remote
    for remote in dataset.files:
        if Path(remote.path).name == file.name or len(dataset.files) == 1:
            return remote
    if not dataset.files:
        return Remote(file.name, dataset.page)
    raise BufgymError(
        where(file, None, None, f"no file of {dataset.name}, by its name or its checksum (sha256 {found}); its files: ")
        + ", ".join(remote.path for remote in dataset.files[:3])
        + (", ..." if len(dataset.files) > 3 else "")
    )


def _settled(remote: Remote, target: Path, found: str, origin: Origin) -> Fetched:
    """The file is in its place: its content is unpacked."""
    try:
        unpacked = _unpacked(target, renew=origin != "there already")
    except BufgymError:
        if remote.sha256 is None:
            # Nothing vouches for a file that does not unpack: the next attempt shall fetch it anew.
            target.unlink()
        raise
    return Fetched(target, found, remote.sha256 is not None, origin, unpacked)


def _unpacked(archive: Path, renew: bool) -> Path | None:
    """The folder with the archive's content, beside it; None if it is no archive."""
    found = ending(archive.name)
    if found is None:
        return None
    folder = archive.with_name(archive.name[: -len(found)])
    if renew and folder.exists():
        # First out of sight in one step, so that nothing half removed is taken for whole.
        stale = folder.with_name(f".{folder.name}.stale")
        shutil.rmtree(stale, ignore_errors=True)
        with disk(folder):
            folder.rename(stale)
        shutil.rmtree(stale, ignore_errors=True)
    if not folder.exists():
        unpack(archive, folder)
    return folder


def _wrong(source: object, found: str, expected: str | None) -> BufgymError:
    return BufgymError(f"{source}: wrong checksum: sha256 is {found}, must be {expected}; not kept")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def _alone(lock: Path, waiting: Callable[[], None]) -> Iterator[None]:
    """One process at a time; the system frees the lock of a process that dies."""
    with disk(lock):
        handle = lock.open("ab")
    with handle:
        if sys.platform == "win32":
            import msvcrt
            import time

            told = False
            while True:
                try:
                    msvcrt.locking(handle.fileno(), msvcrt.LK_NBLCK, 1)
                    break
                except OSError:
                    if not told:
                        waiting()
                    told = True
                    time.sleep(0.2)
        else:
            import fcntl

            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                waiting()
                fcntl.flock(handle, fcntl.LOCK_EX)
        yield

"""Public data sets in a cache folder: downloaded or copied from files, verified, unpacked.

Every file in the cache is complete and has the checksum that is known for it: pooch downloads and verifies it in a
folder of its own (`.NAME.part`), from which it takes its place by one renaming. Each data set has a lock, so that one
process fetches at a time; the others wait and then find the files. An archive is unpacked beside itself.
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal
from urllib.parse import urljoin

from bufgym.traces.datasets.table import Dataset, Remote, datasets
from bufgym.traces.datasets.unpack import ending, unpack
from bufgym.traces.formats.faults import StrPath, os_errors
from bufgym.utils import __version__, files
from bufgym.utils.errors import BufgymError, where

MAX_BYTES: Final = 64 * 2**30  # No file may be longer
SILENCE_S: Final = 30.0  # An attempt fails when the server sends nothing for so long, s
RETRIES: Final = 2  # Further attempts after the first has failed

Origin = Literal["downloaded", "there already", "copied"]


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
    """Where data sets are cached: `bufgym/datasets` in XDG_CACHE_HOME, or else in the platform's cache folder."""
    import pooch

    return Path(pooch.os_cache("bufgym")) / "datasets"


def fetch_dataset(
    dataset: str | Dataset,
    to: StrPath | None = None,
    local_files: Sequence[StrPath] = (),
    *,
    note: Callable[[str], None] = lambda sentence: None,
) -> list[Fetched]:
    """Put a data set into `to`/NAME.

    Args:
        dataset: a name of `datasets()`, or a data set of your own.
        to: the folder for data sets, by default `cache_folder()`.
        local_files: files fetched by hand, recognised by name or checksum; if there are any, nothing is downloaded.
        note: called with what happens, in sentences.

    Returns:
        The files, in the order of the data set or of `local_files`.

    Raises:
        BufgymError: no such data set, an unknown address, no network, no such file, a server that fails again and
            again, a wrong checksum, an HTML page, no room on the disk, an archive that `unpack` refuses.
    """
    from filelock import FileLock, Timeout

    if isinstance(dataset, str):
        if dataset not in datasets():
            raise BufgymError(f"{dataset}: no such data set: must be one of {', '.join(datasets())}")
        dataset = datasets()[dataset]
    if not dataset.files and not local_files:
        raise BufgymError(
            f"{dataset.name}: the address of its files is not known: fetch them by hand from {dataset.page} and "
            f"name them with --from FILE"
        )
    root = cache_folder() if to is None else Path(to)
    folder = root / dataset.name
    with os_errors(folder, "written"):
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(root / f".{dataset.name}.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            note(f"waiting for another bufgym that fetches {dataset.name}")
            lock.acquire()
    try:
        if local_files:
            return [_copied(dataset, folder, Path(file)) for file in local_files]
        return [_downloaded(remote, folder, note) for remote in dataset.files]
    finally:
        lock.release()


def _downloaded(remote: Remote, folder: Path, note: Callable[[str], None]) -> Fetched:
    target = folder / remote.path
    if target.is_file():
        checksum = _sha256(target)
        if remote.sha256 in (None, checksum):
            return _settled(remote, target, checksum, "there already")
        note(f"{target}: changed since it was fetched: fetching it again")
    note(f"downloading {remote.address}")
    scratch = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(scratch, ignore_errors=True)  # of a process that was killed
    try:
        _download(remote, scratch / "file")
        return _placed(remote, scratch / "file", target, "downloaded")
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _download(remote: Remote, part: Path) -> None:
    import pooch

    pooch.get_logger().setLevel("WARNING")
    downloader = pooch.HTTPDownloader(
        progressbar=_Limit(remote.address),
        timeout=SILENCE_S,
        headers={"User-Agent": f"bufgym/{__version__}", "Accept-Encoding": "identity"},
        hooks={"response": _refuse_plain},
    )
    registry, urls = {part.name: remote.sha256}, {part.name: remote.address}
    cache = pooch.create(part.parent, base_url="", registry=registry, urls=urls, retry_if_failed=RETRIES)
    try:
        cache.fetch(part.name, downloader=downloader)
    except BufgymError:
        raise
    except (OSError, ValueError) as error:
        raise BufgymError(f"{remote.address}: {_said(error)}") from None


class _Limit:
    """What pooch calls a progress bar: hears of every piece of a file, and stops one without end."""

    def __init__(self, address: str) -> None:
        self._address = address
        self.total = self._count = 0

    def update(self, count: int) -> None:
        self._count += count
        if self._count > MAX_BYTES:
            raise BufgymError(f"{self._address}: sends more than {MAX_BYTES} bytes: must be less")

    def reset(self) -> None:
        self._count = 0

    def close(self) -> None:
        """Nothing to close."""


def _refuse_plain(response: Any, **options: Any) -> None:
    """Refuse a redirection from https back to http; requests follows none to anything else."""
    to = urljoin(response.url, response.headers.get("Location", ""))
    if response.is_redirect and response.url.startswith("https:") and not to.startswith("https:"):
        raise BufgymError(f"{response.url}: redirects to {to}, which is not allowed")


def _said(error: Exception) -> str:
    """What went wrong on the way, in one sentence."""
    from requests import exceptions

    if isinstance(error, exceptions.HTTPError):
        said = str(error).partition(" for url")[0]
        if said.startswith("404"):
            return "no such file on the server (404); it may have moved: fetch it by hand, then use --from"
        return f"the server says {said}"
    if isinstance(error, exceptions.SSLError):
        return f"no safe connection to the server ({_reason(error)})"
    if isinstance(error, exceptions.Timeout):
        return "the server does not respond"
    if isinstance(error, exceptions.ConnectionError | exceptions.ChunkedEncodingError):
        return f"no network, no such server, or it broke off ({_reason(error)})"
    if isinstance(error, exceptions.RequestException):
        return f"cannot be downloaded ({_reason(error)})"
    if isinstance(error, OSError):
        return f"cannot be written to the disk: {error.strerror or error}"
    return f"{str(error).partition('. ')[0]}; not kept"  # pooch's: the checksum; or an address that is none


def _reason(error: BaseException) -> str:
    """What the innermost of these errors says, as one line of limited length."""
    while nested := [e for e in (getattr(error, "reason", None), *error.args) if isinstance(e, BaseException)]:
        error = nested[0]
    return " ".join(str(error).rpartition(": ")[2].split())[:200]


def _copied(dataset: Dataset, folder: Path, file: Path) -> Fetched:
    """A file fetched by hand, copied into the cache under its published name."""
    if not file.is_file():
        raise BufgymError(f"{file}: no such file (--from)")
    remote = _recognised(dataset, file, _sha256(file))
    return _placed(remote, file, folder / remote.path, "copied")


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


def _placed(remote: Remote, source: Path, target: Path, origin: Origin) -> Fetched:
    """Put a file into its place in the cache, unless it is an error page."""
    with source.open("rb") as opened:
        start = opened.read(1024).lstrip(b"\xef\xbb\xbf \t\r\n")[:14].lower()
    name = remote.address if origin == "downloaded" else source
    if start.startswith((b"<!doctype html", b"<html")):
        raise BufgymError(f"{name}: is an HTML page, not data (a log-in or error page?)")
    with os_errors(target, "written"):
        target.parent.mkdir(parents=True, exist_ok=True)
        with files.replaced(target) as copy:
            if origin == "copied":
                shutil.copyfile(source, copy)
            else:
                os.replace(source, copy)
            checksum = _sha256(copy)
            if remote.sha256 not in (None, checksum):
                raise BufgymError(f"{name}: wrong checksum: sha256 is {checksum}, must be {remote.sha256}; not kept")
            target.unlink(missing_ok=True)  # first, so that a half removed folder is never taken for a complete one
            if (folder := _unpacked(target)) is not None:
                shutil.rmtree(folder, ignore_errors=True)
    return _settled(remote, target, checksum, origin)


def _settled(remote: Remote, target: Path, checksum: str, origin: Origin) -> Fetched:
    """The file in its place, unpacked if it is an archive."""
    folder = _unpacked(target)
    if folder is not None and not folder.exists():
        try:
            unpack(target, folder)
        except BufgymError:
            if remote.sha256 is None:
                # There is no checksum to verify this file with, so the next attempt must fetch it again.
                target.unlink()
            raise
    return Fetched(target, checksum, remote.sha256 is not None, origin, folder)


def _unpacked(archive: Path) -> Path | None:
    """The folder beside the archive for its content; None if it is no archive."""
    suffix = ending(archive.name)
    return None if suffix is None else archive.with_name(archive.name[: -len(suffix)])


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""The public data sets that `bufgym trace fetch` knows, read from `datasets.toml` and `SHA256SUMS` beside this file.

`SHA256SUMS` has the format of the program `sha256sum` (path = data set / file). Each checksum was computed from a copy
of the published file, as none of these publishers states one. A file in `datasets.toml` alone has no known checksum.
"""

import functools
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

TABLE: Final = Path(__file__).with_name("datasets.toml")
SUMS: Final = Path(__file__).with_name("SHA256SUMS")


@dataclass(frozen=True)
class Remote:
    """A file to fetch."""

    path: str
    """Its path in the data set's folder."""
    address: str
    """An http or https address."""
    sha256: str | None = None
    """Its checksum in hexadecimal digits, None if not known."""


@dataclass(frozen=True)
class Dataset:
    """A public data set."""

    name: str
    """What `bufgym trace fetch` calls it; also its folder."""
    title: str
    """Its full name."""
    holds: str
    """What is in it, in a few words."""
    format: str
    """The format of its files."""
    page: str
    """Its web page, for people."""
    licence: str | None
    """None if not known."""
    citation: str
    """The publication to cite."""
    files: tuple[Remote, ...] = ()
    """What to download; if empty, the files must be fetched by hand from `page`."""


@functools.cache
def checksums() -> dict[str, str]:
    """Path (data set / file) -> SHA-256 in hexadecimal digits."""
    lines = SUMS.read_text(encoding="ascii").splitlines()
    return {path: sha256 for sha256, path in (line.split("  ", 1) for line in lines)}


@functools.cache
def datasets() -> dict[str, Dataset]:
    """Name -> data set, in the order in which they are listed."""
    with TABLE.open("rb") as file:
        table = tomllib.load(file)
    return {name: _dataset(name, entry) for name, entry in table.items()}


def _dataset(name: str, entry: dict[str, Any]) -> Dataset:
    folder, unverified = entry.pop("address", None), entry.pop("without_checksum", [])
    addresses = entry.pop("files", {})
    if folder is not None:
        verified = [path.removeprefix(f"{name}/") for path in checksums() if path.startswith(f"{name}/")]
        addresses = {path: f"{folder}/{path}" for path in [*verified, *unverified]}
    files = [Remote(path, address, checksums().get(f"{name}/{path}")) for path, address in addresses.items()]
    return Dataset(name, licence=entry.pop("licence", None), files=tuple(files), **entry)

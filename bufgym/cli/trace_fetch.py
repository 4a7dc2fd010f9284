"""`bufgym trace fetch`: a public data set into the cache folder."""

from __future__ import annotations

import sys
from collections import Counter
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from bufgym.cli.options import columns
from bufgym.utils.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.traces.datasets.fetch import Fetched
    from bufgym.traces.datasets.table import Dataset

NOT_KNOWN = "not known"


def fetch(
    name: str | None = None,
    /,
    *,
    list: bool = False,
    local_files: Annotated[tuple[str, ...], Parameter(name="--from")] = (),
) -> None:
    """Download a public data set of traces, trajectories or recordings.

    Args:
        name: A data set; --list names them.
        list: Name the data sets, or all that is known of one, and the folder that they go to (XDG_CACHE_HOME moves it).
        local_files: Files fetched by hand: download nothing.
    """
    from bufgym.traces.datasets.fetch import fetch_dataset
    from bufgym.traces.datasets.table import datasets

    table = datasets()
    if name is None:
        if not list:
            raise BufgymError("trace fetch: needs the NAME of a data set (--list names them)")
        print(_overview([*table.values()]))
        return
    if name not in table:
        raise BufgymError(f"{name}: no such data set: must be one of {', '.join(table)}")
    dataset = table[name]
    if list:
        files = [("file", remote.address, f"sha256 {remote.sha256 or NOT_KNOWN}") for remote in dataset.files]
        by_hand = [("address", f"{NOT_KNOWN}: fetch by hand from the page, then --from FILE")]
        print(f"{dataset.name}\n{columns(_about(dataset))}\n{columns(files or by_hand)}".rstrip())
        return
    fetched = fetch_dataset(dataset, None, local_files, note=lambda sentence: print(sentence, file=sys.stderr))
    print(f"{dataset.name}\n{columns([*_results(fetched), *_about(dataset)])}")


def _overview(table: list[Dataset]) -> str:
    from bufgym.traces.datasets.fetch import cache_folder

    lines = [("NAME", "FILES", "WITH SHA256", "LICENCE", "HOLDS")]
    for dataset in table:
        summed = sum(remote.sha256 is not None for remote in dataset.files)
        count = str(len(dataset.files) or "by hand")
        lines.append((dataset.name, count, str(summed), dataset.licence or NOT_KNOWN, dataset.holds))
    sums = "each sha256 was computed from a copy of the published file; no publisher states one"
    return f"{columns(lines)}\n\n  {sums}\n  cached in {cache_folder()}"


def _about(dataset: Dataset) -> list[tuple[str, str]]:
    return [
        ("what", dataset.title),
        ("holds", dataset.holds),
        ("format", dataset.format),
        ("page", dataset.page),
        ("licence", dataset.licence or NOT_KNOWN),
        ("please cite", dataset.citation),
    ]


def _results(fetched: list[Fetched]) -> list[tuple[str, str]]:
    """(heading, text) of each line about what was fetched, at least one file."""
    origins = Counter(file.origin for file in fetched)
    counts = ", ".join(f"{count} {origin}" for origin, count in origins.items())
    verified = sum(file.known for file in fetched)
    lines = [("files", counts), ("sha256", f"{verified} of {len(fetched)} checked against the known sum")]
    lines += [("sha256 found", f"{file.sha256}  {file.path.name} (none known)") for file in fetched if not file.known]
    first = fetched[0].path
    lines.append(("at", str(first if len(fetched) == 1 else first.parent)))
    return lines + [("unpacked", str(file.unpacked)) for file in fetched if file.unpacked is not None]

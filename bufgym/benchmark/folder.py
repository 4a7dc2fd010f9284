"""The folder of ``bufgym bench --suite``: manifest, rows and the timeline of one episode, all checked when read.

``manifest.json`` records the settings, so that runs do not mix their rows.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bufgym.benchmark.rows import Row, read_rows
from bufgym.benchmark.tasks import TASKS, Task
from bufgym.utils.errors import BufgymError, where
from bufgym.utils.files import write_text
from bufgym.utils.strict_json import check, read_object

FORMAT = 2  # Version of the folder's layout, raised when manifest, rows or timeline change their meaning

_MANIFEST = {
    **dict.fromkeys(("task", "suite", "split", "about", "episodes", "bufgym", "command"), str),
    **dict.fromkeys(("unranked", "scenarios", "changes"), dict),
}

_SAME = [
    *("format", "bufgym", "suite", "split", "policies", "policy_file", "sources", "made_of"),
    *("capacities", "seeds", "changes", "scenarios"),
]
"""Entries that must be equal in two runs that share a folder."""

_ROWS = ("rows.parquet", "rows.csv")
_TIMELINE = {"scenario": str, "capacity": int, "arrival_s": list, "x": list, "rate": dict, "policies": dict}
_LANE = {"qoi": (int, float), "received": list, "dropped": list}


@dataclass(frozen=True)
class SuiteRun:
    """One finished run of a suite."""

    folder: Path
    manifest: Mapping[str, Any]  # its settings
    rows: list[Row]
    rows_file: Path  # for error messages
    timeline: Mapping[str, Any] | None  # one episode, message by message; None if none was written

    @property
    def task(self) -> Task:
        return TASKS[self.manifest["task"]]

    @property
    def abouts(self) -> dict[str, str]:
        """Map each scenario's label to its description."""
        return {label: str(entry.get("about", "")) for label, entry in self.manifest["scenarios"].items()}


def read(folder: Path) -> SuiteRun:
    """Read the run in ``folder``; an error names the file and the broken rule."""
    if not folder.is_dir():
        raise BufgymError(f"{folder}: must be a folder that `bufgym bench --suite` wrote")
    entries = read_manifest(folder / "manifest.json")
    timeline = folder / "timeline.json"
    if (folder / "parts").is_dir() and not any((folder / name).exists() for name in _ROWS):
        raise BufgymError(
            f"{folder}: this run is not finished; the command that began it resumes it: {entries['command']}"
        )
    rows, rows_file = _rows(folder, TASKS[entries["task"]])
    return SuiteRun(folder, entries, rows, rows_file, _timeline(timeline) if timeline.exists() else None)


def _rows(folder: Path, task: Task) -> tuple[list[Row], Path]:
    for name in _ROWS:
        path = folder / name
        if path.exists():
            rows = read_rows(path, task.layout)
            if not rows:
                raise BufgymError(f"{path}: must hold at least one row")
            for column in task.needed:
                if column not in rows[0]:
                    raise BufgymError(f"{path}: no column {column!r}; a suite's rows have {', '.join(task.needed)}")
            return rows, path
    raise BufgymError(f"{folder}: no rows.parquet and no rows.csv; one of them must be there")


def _timeline(path: Path) -> Mapping[str, Any]:
    episode = read_object(path)
    check(path, "", episode, _TIMELINE)
    messages = len(episode["arrival_s"])
    if messages == 0 or len(episode["x"]) != messages:
        raise BufgymError(f"{path}: arrival_s and x must have one entry a message, at least one")
    rate = episode["rate"]
    check(path, "rate", rate, {"t_s": list, "bytes_per_s": list})
    if len(rate["t_s"]) != len(rate["bytes_per_s"]):
        raise BufgymError(f"{path}: rate.t_s and rate.bytes_per_s must be of one length")
    series = {"arrival_s": episode["arrival_s"], "x": episode["x"], **{f"rate.{k}": rate[k] for k in rate}}
    for field, numbers in series.items():
        if not _are_numbers(numbers):
            raise BufgymError(f"{path}: {field} must hold numbers alone")
    for name, lane in episode["policies"].items():
        check(path, f"policies.{name}", lane, _LANE)
        for kind, length in (("received", 3), ("dropped", 2)):
            for entry in lane[kind]:
                known = isinstance(entry, list) and len(entry) == length and _are_numbers(entry)
                if not known or not (isinstance(entry[0], int) and 0 <= entry[0] < messages):
                    rule = f"must be {length} numbers, the first a message 0..{messages - 1}"
                    raise BufgymError(where(path, None, entry, rule, field=f"policies.{name}.{kind}"))
    return episode


def _are_numbers(entries: Any) -> bool:
    return isinstance(entries, list) and all(isinstance(number, int | float) for number in entries)


@contextmanager
def made(out: Path) -> Iterator[None]:
    """Make the folder. If the block fails and nothing is in it, remove it, with the parents that were made for it."""
    new = [folder for folder in (out, *out.parents) if not folder.exists()]
    out.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):  # the first that is not empty
            for folder in new:
                folder.rmdir()
        raise


def claim(out: Path, manifest: dict[str, Any]) -> None:
    """Write the manifest into the folder; raise an error if another run's rows are in it."""
    file = out / "manifest.json"
    if not file.exists():
        if (out / "parts").exists() or any(out.glob("rows.*")):
            raise BufgymError(f"{out}: holds rows without a manifest.json; choose another --out")
        write_text(file, json.dumps(manifest, indent=1))
        return
    held = read_manifest(file)
    for key in _SAME:
        if held.get(key) != manifest[key]:
            raise BufgymError(
                f"{file}: {key} is {_short(held.get(key))}, but this run has {_short(manifest[key])};"
                " choose another --out (finished rows are never mixed)"
            )


def check_free(out: Path) -> None:
    """Raise an error if rows are in the folder, which a run that is not a suite's never writes over."""
    if (out / "manifest.json").exists():
        raise BufgymError(f"{out}: holds the run of a suite; choose another --out (its rows are never written over)")
    for rows in sorted(out.glob("rows.*")):
        raise BufgymError(f"{rows}: holds an earlier run's rows; choose another --out, or remove that file")


def form_of_rows(out: Path) -> str:
    """Format of the rows already in the folder, or else the best format available."""
    held = {file.suffix for pattern in ("rows.*", "parts/*") for file in out.glob(pattern)}
    return "csv" if not find_spec("pyarrow") or (".csv" in held and ".parquet" not in held) else "parquet"


def read_manifest(path: Path) -> Mapping[str, Any]:
    """Read a manifest of this version; an error names the file and the broken rule."""
    if not path.exists():
        raise BufgymError(f"{path.parent}: no {path.name}; it must be a folder that `bufgym bench --suite` wrote")
    manifest = read_object(path)
    if manifest.get("format") != FORMAT:
        rule = f"must be {FORMAT}; another version of bufgym wrote this folder"
        raise BufgymError(where(path, None, manifest.get("format"), rule, field="format"))
    check(path, "", manifest, _MANIFEST)
    if manifest["task"] not in TASKS:
        raise BufgymError(where(path, None, manifest["task"], f"must be one of {', '.join(TASKS)}", field="task"))
    for label, scenario in manifest["scenarios"].items():
        check(path, f"scenarios.{label}", scenario, {})
        if not isinstance(scenario.get("outage_s", 0.0), int | float):
            rule = "must be a number of seconds"
            raise BufgymError(where(path, None, scenario["outage_s"], rule, field=f"scenarios.{label}.outage_s"))
    return manifest


def _short(entry: object) -> str:
    text = json.dumps(entry)
    return text if len(text) <= 80 else f"{text[:77]}..."

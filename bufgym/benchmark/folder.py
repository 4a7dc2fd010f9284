"""What ``bufgym bench --suite`` left in a folder, read and checked: manifest, rows, the timeline of one episode."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bufgym.benchmark.rows import Row, read_rows
from bufgym.errors import BufgymError, where

FORMAT = 1
"""The version of the folder's layout: raised when manifest, rows or timeline change their meaning."""

NEEDED = ("scenario", "trace", "seed", "capacity", "policy", "qoi", "mean_sojourn_s", "mean_age_s")
"""Columns that the report itself needs; the statistics ask for theirs."""

_MANIFEST = {"suite": str, "split": str, "bufgym": str, "command": str, "unranked": dict, "scenarios": dict}
_TIMELINE = {"scenario": str, "capacity": int, "arrival_s": list, "x": list, "rate": dict, "policies": dict}
_LANE = {"qoi": (int, float), "received": list, "dropped": list}


@dataclass(frozen=True)
class Run:
    """One finished run of a suite."""

    folder: Path
    manifest: Mapping[str, Any]
    rows: list[Row]
    rows_file: Path
    timeline: Mapping[str, Any] | None
    """One episode, message by message; None where none was written."""

    def place(self, scenario: str) -> tuple[int, str]:
        """Sorts scenarios as the manifest lists them; any others come after, by name."""
        listed = list(self.manifest["scenarios"])
        return (listed.index(scenario) if scenario in listed else len(listed), scenario)


def read(folder: Path) -> Run:
    """The run in ``folder``; an error that names the file and the rule where it is not one."""
    if not folder.is_dir():
        raise BufgymError(f"{folder}: must be a folder that `bufgym bench --suite` wrote")
    manifest = read_manifest(folder / "manifest.json")
    timeline = folder / "timeline.json"
    rows, rows_file = _rows(folder)
    return Run(folder, manifest, rows, rows_file, _timeline(timeline) if timeline.exists() else None)


def read_manifest(path: Path) -> Mapping[str, Any]:
    """What was run; an error that names the file and the rule where it is not a manifest of this version."""
    if not path.exists():
        raise BufgymError(f"{path.parent}: no {path.name}; it must be a folder that `bufgym bench --suite` wrote")
    found = _json(path)
    if found.get("format") != FORMAT:
        rule = f"must be {FORMAT}; another version of bufgym wrote this folder"
        raise BufgymError(where(path, None, found.get("format"), rule, field="format"))
    _check(path, "", found, _MANIFEST)
    for label, about in found["scenarios"].items():
        _check(path, f"scenarios.{label}", about, {})
        if not isinstance(about.get("outage_s", 0.0), int | float):
            rule = "must be a number of seconds"
            raise BufgymError(where(path, None, about["outage_s"], rule, field=f"scenarios.{label}.outage_s"))
    return found


def _rows(folder: Path) -> tuple[list[Row], Path]:
    for name in ("rows.parquet", "rows.csv"):
        path = folder / name
        if path.exists():
            rows = read_rows(path)
            if not rows:
                raise BufgymError(f"{path}: must hold at least one row")
            for column in NEEDED:
                if column not in rows[0]:
                    raise BufgymError(f"{path}: no column {column!r}; a suite's rows have {', '.join(NEEDED)}")
            return rows, path
    raise BufgymError(f"{folder}: no rows.parquet and no rows.csv; one of them must be there")


def _timeline(path: Path) -> Mapping[str, Any]:
    found = _json(path)
    _check(path, "", found, _TIMELINE)
    messages = len(found["arrival_s"])
    if messages == 0 or len(found["x"]) != messages:
        raise BufgymError(f"{path}: arrival_s and x must have one entry a message, at least one")
    rate = found["rate"]
    _check(path, "rate", rate, {"t_s": list, "bytes_per_s": list})
    if len(rate["t_s"]) != len(rate["bytes_per_s"]):
        raise BufgymError(f"{path}: rate.t_s and rate.bytes_per_s must be of one length")
    for field, numbers in (
        ("arrival_s", found["arrival_s"]),
        ("x", found["x"]),
        *((f"rate.{k}", rate[k]) for k in rate),
    ):
        if not _are_numbers(numbers):
            raise BufgymError(f"{path}: {field} must hold numbers alone")
    for name, lane in found["policies"].items():
        _check(path, f"policies.{name}", lane, _LANE)
        for kind, length in (("received", 3), ("dropped", 2)):
            for entry in lane[kind]:
                known = isinstance(entry, list) and len(entry) == length and _are_numbers(entry)
                if not known or not (isinstance(entry[0], int) and 0 <= entry[0] < messages):
                    rule = f"must be {length} numbers, the first a message 0..{messages - 1}"
                    raise BufgymError(where(path, None, entry, rule, field=f"policies.{name}.{kind}"))
    return found


def _are_numbers(found: Any) -> bool:
    return isinstance(found, list) and all(isinstance(number, int | float) for number in found)


def _json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except UnicodeDecodeError:
        raise BufgymError(f"{path}: must be UTF-8 text") from None
    except json.JSONDecodeError as error:
        raise BufgymError(where(path, error.lineno, None, f"must be JSON: {error.msg}")) from None
    except ValueError as error:
        raise BufgymError(f"{path}: {error}") from None
    if not isinstance(found, dict):
        raise BufgymError(f"{path}: must be a JSON object")
    return found


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant}: numbers must be finite")


def _check(path: Path, place: str, found: Any, kinds: Mapping[str, Any]) -> None:
    """Every entry of ``kinds`` is there and of its kind."""
    if not isinstance(found, dict):
        raise BufgymError(f"{path}: {place} must be an object")
    for name, kind in kinds.items():
        field = f"{place}.{name}" if place else name
        if name not in found:
            raise BufgymError(f"{path}: no {field}")
        if not isinstance(found[name], kind):
            words = {str: "text", list: "a list", dict: "an object", int: "a whole number"}.get(kind, "a number")
            raise BufgymError(where(path, None, found[name], f"must be {words}", field=field))

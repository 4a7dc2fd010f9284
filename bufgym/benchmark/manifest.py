"""JSON files of a run's folder; ``manifest.json`` records the settings, so that runs do not mix their rows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bufgym.benchmark.checked_json import check, read_object
from bufgym.benchmark.tasks import TASKS
from bufgym.ground.errors import BufgymError, where
from bufgym.ground.files import replaced

FORMAT = 2
"""Version of the folder's layout, raised when manifest, rows or timeline change their meaning."""

_KINDS = {
    **dict.fromkeys(("task", "suite", "split", "about", "episodes", "bufgym", "command"), str),
    **dict.fromkeys(("unranked", "scenarios", "changes"), dict),
}

_SAME = [
    *("format", "bufgym", "suite", "split", "policies", "policy_file", "sources"),
    *("capacities", "seeds", "changes", "scenarios"),
]
"""Entries that must be equal in two runs that share a folder."""


def claim(out: Path, manifest: dict[str, Any]) -> None:
    """Write the manifest into the folder; raise an error if another run's rows are in it."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "manifest.json"
    if not file.exists():
        if (out / "parts").exists() or any(out.glob("rows.*")):
            raise BufgymError(f"{out}: holds rows without a manifest.json; choose another --out")
        write_json(file, manifest)
        return
    held = read(file)
    for key in _SAME:
        if held.get(key) != manifest[key]:
            raise BufgymError(
                f"{file}: {key} is {_short(held.get(key))}, but this run has {_short(manifest[key])};"
                " choose another --out (finished rows are never mixed)"
            )


def read(path: Path) -> Mapping[str, Any]:
    """Read a manifest of this version; an error names the file and the broken rule."""
    if not path.exists():
        raise BufgymError(f"{path.parent}: no {path.name}; it must be a folder that `bufgym bench --suite` wrote")
    manifest = read_object(path)
    if manifest.get("format") != FORMAT:
        rule = f"must be {FORMAT}; another version of bufgym wrote this folder"
        raise BufgymError(where(path, None, manifest.get("format"), rule, field="format"))
    check(path, "", manifest, _KINDS)
    if manifest["task"] not in TASKS:
        raise BufgymError(where(path, None, manifest["task"], f"must be one of {', '.join(TASKS)}", field="task"))
    for label, scenario in manifest["scenarios"].items():
        check(path, f"scenarios.{label}", scenario, {})
        if not isinstance(scenario.get("outage_s", 0.0), int | float):
            rule = "must be a number of seconds"
            raise BufgymError(where(path, None, scenario["outage_s"], rule, field=f"scenarios.{label}.outage_s"))
    return manifest


def write_json(file: Path, content: dict[str, Any]) -> None:
    """Write the file, whole or not at all."""
    with replaced(file) as temporary:
        temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")


def _short(entry: object) -> str:
    text = json.dumps(entry)
    return text if len(text) <= 80 else f"{text[:77]}..."

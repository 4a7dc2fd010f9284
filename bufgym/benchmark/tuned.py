"""Choices of ``python -m studies.tune`` in ``tuned.json``: ``bufgym bench --suite`` uses them as variants."""

from pathlib import Path
from typing import Any

from bufgym import policies
from bufgym.benchmark.checked_json import read_object
from bufgym.ground.errors import BufgymError, where

FILE = Path(__file__).with_name("tuned.json")
"""{suite: {policy: {"setting", "score", "default_score", "split", "command", "bufgym", ...}}}."""


def read() -> dict[str, dict[str, dict[str, Any]]]:
    """Read ``tuned.json``; an error names the file and the broken rule."""
    suites = read_object(FILE)
    if not all(isinstance(entries, dict) for entries in suites.values()):
        raise BufgymError(f"{FILE}: must be a JSON object of suites, each an object of policies")
    for suite, entries in suites.items():
        for policy, entry in entries.items():
            setting = entry.get("setting") if isinstance(entry, dict) else None
            if not isinstance(setting, str) or setting.partition(":")[0] != policy:
                rule = f"must be a setting of that policy, such as {policy}:parameter=1"
                raise BufgymError(where(FILE, None, setting or "", rule, field=f"{suite}.{policy}.setting"))
    return suites


def tuned(suite: str) -> list[str]:
    """List the settings chosen for this suite that differ from the policies' defaults."""
    settings = []
    for policy, entry in read().get(suite, {}).items():
        try:
            setting, default = policies.get(entry["setting"]), policies.get(policy)
        except BufgymError as error:
            raise BufgymError(f"{FILE}: {suite}.{policy}: {error}") from None
        if setting.parameters != default.parameters:
            settings.append(setting.name)
    return settings

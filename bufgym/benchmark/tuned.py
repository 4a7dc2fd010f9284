"""Choices of ``python -m studies.tune`` in ``tuned.json``: ``bufgym bench --suite`` uses them as variants."""

from pathlib import Path

from bufgym import policies
from bufgym.utils.strict_json import read_object

FILE = Path(__file__).with_name("tuned.json")
"""{suite: {policy: {"setting", "score", "default_score", "split", "command", "bufgym", ...}}}, a file of our own."""


def tuned(suite: str) -> list[str]:
    """List the settings chosen for this suite that differ from the policies' defaults."""
    chosen = ((entry["setting"], policy) for policy, entry in read_object(FILE).get(suite, {}).items())
    pairs = [(policies.get(setting), policies.get(policy)) for setting, policy in chosen]
    return [setting.name for setting, default in pairs if setting.parameters != default.parameters]

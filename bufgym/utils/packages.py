"""Packages beside bufgym: what each declares to add, and the message where the package is not installed."""

import glob
import importlib
import sys
import tomllib
from collections.abc import Iterable
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import Any, NoReturn

from bufgym.utils.errors import BufgymError
from bufgym.utils.files import PACKAGE

COMMANDS, ENVIRONMENTS = "bufgym.commands", "bufgym.environments"
"""Groups of entry points: what an installed package adds."""


def declared(group: str) -> dict[str, Any]:
    """Entry points of the group, by name, loaded; where two packages declare a name, the one that Python finds first.

    ``importlib.metadata`` finds the same, and takes longer to import than all the rest of bufgym's start.
    """
    places: dict[str, str] = {}
    for folder in sys.path:
        for file in glob.iglob(f"{glob.escape(folder or '.')}/*-info/entry_points.txt"):
            with suppress(OSError):
                text = Path(file).read_text(encoding="utf-8", errors="replace")
                for line in text.partition(f"[{group}]\n")[2].partition("\n[")[0].splitlines():
                    name, is_entry, place = line.partition("=")
                    if is_entry and name[0] not in "#;":
                        places.setdefault(name.strip(), place.strip())
    pairs = {name: place.partition(":") for name, place in places.items()}
    return {name: attrgetter(what)(importlib.import_module(module)) for name, (module, _, what) in pairs.items()}


def absent(group: str, installed: Iterable[str]) -> dict[str, str]:
    """Entry points of the group that are declared and not ``installed`` -> the package, and the command that brings it.

    A checkout has the packages' folders; a wheel carries their declarations as ``bufgym/data/packages/NAME.toml``.
    """
    messages, held = {}, set(installed)
    carried = sorted((PACKAGE / "data" / "packages").glob("*.toml"))
    for file in carried or sorted((PACKAGE.parent / "packages").glob("*/pyproject.toml")):
        text = file.read_text(encoding="utf-8")
        if group not in text:
            continue
        project = tomllib.loads(text)["project"]
        folder = f"packages/{file.stem}, in bufgym's source tree" if carried else f"-e {file.parent}"
        for name in project.get("entry-points", {}).get(group, {}):
            if name not in held:
                messages[name] = f"comes with the package {project['name']}: pip install {folder}"
    return messages


def raise_absent(message: str, **_: Any) -> NoReturn:
    """Stand in for an environment whose package is not installed."""
    raise BufgymError(message)

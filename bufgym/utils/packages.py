"""Packages beside bufgym: what each declares to add, and the message where the package is not installed."""

import re
import tomllib
from collections.abc import Iterable
from typing import Any, NoReturn

from bufgym.utils.errors import BufgymError
from bufgym.utils.files import PACKAGE

COMMANDS, ENVIRONMENTS = "bufgym.commands", "bufgym.environments"
"""Groups of entry points: what an installed package adds."""


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
        beside = (re.match(r"bufgym-(\w+)", text) for text in project.get("dependencies", ()))
        needed = [*(found[1] for found in beside if found), project["name"].removeprefix("bufgym-")]
        if carried:
            folder = f"{' '.join(f'packages/{one}' for one in needed)}, in bufgym's source tree"
        else:
            folder = " ".join(f"-e {file.parent.parent / one}" for one in needed)
        for name in project.get("entry-points", {}).get(group, {}):
            if name not in held:
                messages[name] = f"comes with the package {project['name']}: pip install {folder}"
    return messages


def raise_absent(message: str, **_: Any) -> NoReturn:
    """Stand in for an environment whose package is not installed."""
    raise BufgymError(message)

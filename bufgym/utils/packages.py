"""Packages beside bufgym: what each declares to add, and the message where the package is not installed."""

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
        folder = f"packages/{file.stem}, in bufgym's source tree" if carried else f"-e {file.parent}"
        for name in project.get("entry-points", {}).get(group, {}):
            if name not in held:
                messages[name] = f"comes with the package {project['name']}: pip install {folder}"
    return messages


def raise_absent(message: str, **_: Any) -> NoReturn:
    """Stand in for an environment whose package is not installed."""
    raise BufgymError(message)

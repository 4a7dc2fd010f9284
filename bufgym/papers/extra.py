"""Libraries of the extras, imported where they are used."""

from __future__ import annotations

import importlib
from typing import Any

from bufgym.ground.errors import BufgymError, install


def library(name: str, extra: str = "perception") -> Any:
    """Import the module of that name; raise an error that names the extra if it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != name.split(".")[0]:
            raise
        raise BufgymError(f"bufgym.papers needs {error.name}: {install(extra)}") from None

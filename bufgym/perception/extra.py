"""What the extra ``perception`` brings, imported where it is used."""

from __future__ import annotations

import importlib
from typing import Any

from bufgym.errors import BufgymError, install


def library(name: str) -> Any:
    """The module of that name; an error that names the extra if it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != name.split(".")[0]:
            raise
        raise BufgymError(f"bufgym.perception needs {error.name}: {install('perception')}") from None

"""Libraries of the extras, imported where they are used."""

import importlib
from typing import Any

from bufgym.ground.errors import BufgymError, install


def library(name: str, extra: str = "perception", user: str = "bufgym") -> Any:
    """Import the module of that name; the error where it is missing says that ``user`` needs the extra."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != name.split(".")[0]:
            raise
        raise BufgymError(f"{user} needs {error.name}: {install(extra)}") from None

"""Libraries of the extras, imported where they are used."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from bufgym.utils.errors import BufgymError, install


@contextmanager
def needs(libraries: str | tuple[str, ...], extra: str, user: str = "bufgym") -> Iterator[None]:
    """Raise an error that says that ``user`` needs the extra if the block can't import one of its libraries."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ((libraries,) if isinstance(libraries, str) else libraries):
            raise
        raise missing(user, error.name, extra) from None


def missing(user: str, library: str | None, extra: str) -> BufgymError:
    """The error that ``user`` needs a library that is not installed, with the command that installs its extra."""
    return BufgymError(f"{user} needs {library}: {install(extra)}")


def library(name: str, extra: str, user: str = "bufgym") -> Any:
    """Import the module of that name, which comes with the extra; see ``needs``."""
    with needs(name.split(".")[0], extra, user):
        return importlib.import_module(name)

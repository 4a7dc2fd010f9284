"""What the extra ``live`` brings, imported where it is used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from bufgym.errors import BufgymError, install


@contextmanager
def needs(library: str) -> Iterator[None]:
    """An error that names the extra if ``library`` is missing, which the block imports."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != library:
            raise
        raise BufgymError(f"bufgym.live needs {error.name}: {install('live')}") from None

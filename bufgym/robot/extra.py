"""Libraries of the extras ``live`` and ``zenoh``, imported where they are used."""

from collections.abc import Iterator
from contextlib import contextmanager

from bufgym.ground.errors import BufgymError, install


@contextmanager
def needs(library: str, extra: str = "live", room: str = "bufgym.robot") -> Iterator[None]:
    """Raise an error that names ``room`` and ``extra`` if the block can't import ``library``."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != library:
            raise
        raise BufgymError(f"{room} needs {error.name}: {install(extra)}") from None

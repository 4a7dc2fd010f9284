"""Libraries of the extra ``relay``, imported where they are used."""

from __future__ import annotations

from contextlib import AbstractContextManager

from bufgym.robot import extra


def needs(library: str) -> AbstractContextManager[None]:
    """Raise an error that names the extra if the block can't import ``library``."""
    return extra.needs(library, "relay", "bufgym.relay")

"""What the extra ``relay`` brings, imported where it is used."""

from __future__ import annotations

from contextlib import AbstractContextManager

from bufgym.live import extra


def needs(library: str) -> AbstractContextManager[None]:
    """An error that names the extra if ``library`` is missing, which the block imports."""
    return extra.needs(library, "relay", "bufgym.relay")

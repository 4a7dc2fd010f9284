"""Libraries of the extras ``live`` and ``zenoh``, imported where they are used."""

from bufgym.ground.libraries import needs

__all__ = ["needs"]

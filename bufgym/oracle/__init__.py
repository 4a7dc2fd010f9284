"""The truth to measure against."""

from bufgym.oracle.interruption import ideal, integer

__all__ = ["ideal", "integer"]

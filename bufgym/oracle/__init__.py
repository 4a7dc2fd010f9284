"""Bounds for policies: the best possible in one interruption, on any link, and without knowing T."""

from bufgym.oracle.clairvoyant import Plan, clairvoyant
from bufgym.oracle.interruption import by_length, ideal, integer
from bufgym.oracle.online import OnlineOptimum, law, online_optimum

__all__ = [
    "OnlineOptimum",
    "Plan",
    "by_length",
    "clairvoyant",
    "ideal",
    "integer",
    "law",
    "online_optimum",
]

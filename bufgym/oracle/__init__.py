"""Bounds for policies: the best possible in one interruption, on any link, and without knowing T."""

from bufgym.oracle.clairvoyant import Plan, clairvoyant
from bufgym.oracle.interruption import law
from bufgym.oracle.measure import normalised_score
from bufgym.oracle.online import online_optimum

__all__ = ["Plan", "clairvoyant", "law", "normalised_score", "online_optimum"]

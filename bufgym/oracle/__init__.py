"""Bounds for policies: the best possible in one interruption, on any link, and without knowing T."""

from bufgym.oracle.clairvoyant import Plan, clairvoyant
from bufgym.oracle.interruption import EveryLength, ideal, integer, law
from bufgym.oracle.measure import BASELINE, measured, normalised_score, regret
from bufgym.oracle.online import OnlineOptimum, online_optimum

__all__ = [
    "BASELINE", "EveryLength", "OnlineOptimum", "Plan", "clairvoyant", "ideal", "integer", "law",
    "measured", "normalised_score", "online_optimum", "regret",
]  # fmt: skip

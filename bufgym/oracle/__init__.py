"""The truth to measure against."""

from bufgym.oracle.clairvoyant import Plan, clairvoyant
from bufgym.oracle.interruption import ideal, integer
from bufgym.oracle.online import OnlineOptimum, law, online_optimum

__all__ = ["OnlineOptimum", "Plan", "clairvoyant", "ideal", "integer", "law", "online_optimum"]

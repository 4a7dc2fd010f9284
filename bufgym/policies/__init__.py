"""Drop policies by name: ``get("afr")``, ``names()``, and ``register`` for your own."""

from bufgym.buffer import ACCEPT, REJECT
from bufgym.policies import (  # noqa: F401  (each registers its policies)
    afr,
    checkpointing,
    classic,
    gaps,
    managed,
    middleware,
    sampling,
)
from bufgym.policies.registry import Policy, get, names, register, runs_compiled

__all__ = ["ACCEPT", "REJECT", "Policy", "get", "names", "register", "runs_compiled"]

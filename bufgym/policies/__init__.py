"""Drop policies by name: ``get("afr")``, ``names()``, ``register`` for your own, ``load`` for a learned one's file."""

import functools

from bufgym import files
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
from bufgym.policies.registry import Policy, get, names, register, register_later, runs_compiled
from bufgym.policies.weights import load, load_shipped

__all__ = ["ACCEPT", "REJECT", "Policy", "get", "load", "names", "register", "runs_compiled"]

for _name, _path in files.shipped("agents", "agents/pretrained", "*.safetensors").items():
    register_later(_name, functools.partial(load_shipped, _name, _path))

"""Drop policies by name: ``get("afr")``, ``names()``, ``register`` for your own, and ``load`` for a learned one."""

import functools
import os

from bufgym.model.buffer import ACCEPT, HOLD, REJECT, is_first
from bufgym.policies import (  # noqa: F401  (each registers its policies)
    afr,
    aqm,
    checkpointing,
    classic,
    fragments,
    gap_priority,
    gaps,
    middleware,
    price_dp,
    robofleet,
    sampling,
    schedulers,
    target_gap,
    webrtc,
)
from bufgym.policies.registry import Policy, get, names, register, register_later
from bufgym.policies.schedulers import make_room
from bufgym.utils import files

__all__ = [
    "ACCEPT", "HOLD", "REJECT", "Policy", "get", "is_first", "load", "make_room", "names", "register",
]  # fmt: skip


def load(path: str | os.PathLike[str]) -> Policy:
    """Load the learned policy in a file, as ``bufgym.policies.weights.load``."""
    from bufgym.policies import weights  # not at start-up: few users need safetensors

    return weights.load(path)


for _folder, _rules in (("", {}), ("/named", {"named_only": True})):
    _shipped = files.shipped(f"agents{_folder}", f"agents/pretrained{_folder}", "*.safetensors")
    for _name, _path in _shipped.items():
        register_later(_name, functools.partial(load, _path), **_rules)

"""bufgym: the Gymnasium environment for learned buffering on robots.

import gymnasium as gym
import bufgym

env = gym.make("bufgym/Uplink-v1", capacity=8)
envs = gym.make_vec("bufgym/Uplink-v1", num_envs=1024, capacity=8)
print(bufgym.compare(["afr", "drop-oldest"], "lte", capacity=8))
"""

from importlib.metadata import entry_points as _entry_points
from typing import TYPE_CHECKING

import gymnasium as _gym

from bufgym.utils import __version__ as __version__
from bufgym.utils.errors import BufgymError as BufgymError
from bufgym.utils.modules import on_demand as _on_demand
from bufgym.utils.packages import ENVIRONMENTS as _GROUP
from bufgym.utils.packages import absent as _absent

if TYPE_CHECKING:
    from bufgym.benchmark.compare import Comparison, compare, make_policy
    from bufgym.benchmark.curves import curves
    from bufgym.benchmark.own_suite import suite

__all__ = ["BufgymError", "Comparison", "compare", "curves", "make_policy", "suite"]

ENVIRONMENTS = {
    "bufgym/Interruption-v1": ("interruption", "one interruption of unknown length (AFR paper, Sec. III-B)", {}),
    "bufgym/Uplink-v1": ("lte", "a camera stream over bandwidth traces", {}),
    "bufgym/Suite-v1": ("suite", "the episodes of a benchmark suite, split by split", {}),
    "bufgym/Topics-v0": (
        "topics",
        "many topics over one uplink: what to drop, and what to send next (Robofleet)",
        {"capacity": 32},
    ),
}
"""Id -> (name of the scenario, its description, arguments that differ from the usual). Installed packages declare more
of them, as entry points of the group ``bufgym.environments``."""

_EARLIER: dict[str, tuple[str, str, dict[str, object]]] = {
    f"{id.removesuffix('-v1')}-v0": (scenario, about, {**options, "reward": "retained"})
    for id, (scenario, about, options) in ENVIRONMENTS.items()
    if id.endswith("-v1")
}
"""Versions before, which Gymnasium warns of: they differ in the default reward alone."""

_others = {entry.name: entry.load() for entry in _entry_points(group=_GROUP)}
for _id, (_scenario, _, _options) in {**ENVIRONMENTS, **_EARLIER, **_others}.items():
    if _id not in _gym.registry:
        _gym.register(
            _id,
            entry_point="bufgym.envs:SenderEnv",
            vector_entry_point="bufgym.envs:SenderVectorEnv",
            order_enforce=False,  # the environment itself, with its action_masks: it checks calls and actions
            disable_env_checker=True,
            kwargs={"scenario": _scenario, **_options},
        )
for _id, _message in _absent(_GROUP, _gym.registry).items():
    _stand_in = "bufgym.utils.packages:raise_absent"
    _gym.register(_id, _stand_in, vector_entry_point=_stand_in, kwargs={"message": f"{_id} {_message}"})

__getattr__ = _on_demand(
    __name__,
    dict.fromkeys(("Comparison", "compare", "make_policy"), "benchmark.compare")
    | {"curves": "benchmark.curves", "suite": "benchmark.own_suite"},
)

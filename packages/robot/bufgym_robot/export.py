"""``bufgym export``, which also writes policies in C where this package is installed."""

from dataclasses import dataclass
from typing import Literal

from cyclopts import Group, Parameter

from bufgym.cli import export as of_weights
from bufgym.cli.export import WeightOptions
from bufgym.cli.options import Count, given, refuse


@Parameter(name="*", group=Group.create_ordered("C (--to c): one C99 header that decides as Python does"))
@dataclass(frozen=True)
class COptions:
    capacity: Count | None = None
    """L, messages (default: 16)."""
    max_bytes: Count | None = None
    """Bytes queued at most (default: no limit)."""
    value: str | None = None
    """V as in saturating:4 (default: exponential:0.618)."""
    prefix: str | None = None
    """How all its names begin, for several policies in one program (default: bufgym)."""


def export(
    model: str,
    /,
    out: str,
    *,
    to: Literal["safetensors", "c", "roscpp", "ros2"] = "safetensors",
    weights: WeightOptions = WeightOptions(),
    c: COptions = COptions(),
) -> None:
    """Write a trained agent as a file of weights; a policy in C; a library for C++ nodes of ROS 1; a package of ROS 2.

    A model.zip holds pickles, so reading it can run any code: export models of your own alone.

    Args:
        model: The model.safetensors of a run, or the zip of your own PPO, A2C, DQN or MaskablePPO with MlpPolicy
            among candidates. For C: a policy's name, such as afr, or a .safetensors of weights. For roscpp and ros2:
            all, or several of these with commas between.
        out: File to write; for roscpp and ros2 a folder of sources, which the robot compiles.
        to: Kind of file.
    """
    if to != "c":
        refuse(given(c), "belongs to --to c")
    if to == "safetensors":
        of_weights.export(model, out, weights=weights)
        return
    from bufgym import policies
    from bufgym.model import qoi
    from bufgym_robot import c as header

    refuse(given(weights), "belongs to --to safetensors")
    if to in ("roscpp", "ros2"):
        from bufgym_robot import rclcpp, roscpp

        print(f"wrote {(roscpp if to == 'roscpp' else rclcpp).write(out, roscpp.find(model))}")
        return
    policy = policies.load(model) if model.endswith(".safetensors") else policies.get(model)
    value = qoi.load(c.value or "exponential:0.618")
    print(f"wrote {header.write(policy, out, c.capacity or 16, value, c.max_bytes, c.prefix or 'bufgym')}")

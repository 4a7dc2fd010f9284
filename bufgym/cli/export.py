"""``bufgym export`` and ``bufgym dataset make``: agents and policies as files, episodes as a data set."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal

from cyclopts import Group, Parameter

from bufgym.cli.options import Count, Natural, Seeds, given, refuse
from bufgym.ground.errors import BufgymError


@Parameter(name="*", group=Group.create_ordered("Weights (--to safetensors)"))
@dataclass(frozen=True)
class WeightOptions:
    name: str | None = None
    """The policy's name; must be given."""
    about: str | None = None
    """A sentence on the purpose of its training."""


@Parameter(name="*", group=Group.create_ordered("C (--to c): one C99 header that decides as Python does"))
@dataclass(frozen=True)
class COptions:
    capacity: Count | None = None
    """L, messages (default: 16)."""
    max_bytes: Count | None = None
    """Bytes queued at most (default: no limit)."""
    value: str | None = None
    """V as in saturating:4 (default: exponential:0.618)."""


def export(
    model: str,
    /,
    out: str,
    *,
    to: Literal["safetensors", "c"] = "safetensors",
    weights: WeightOptions = WeightOptions(),
    c: COptions = COptions(),
) -> None:
    """Write a trained agent as a file of weights, read without torch; or a policy in C.

    A model.zip holds pickles, so reading it can run any code: export models of your own alone.

    Args:
        model: Of a run of train.py: model.safetensors, or model.zip (--network slots). For C: a policy's name, as afr,
            or a .safetensors of weights.
        out: File to write.
        to: Kind of file.
    """
    from bufgym import policies
    from bufgym.model import qoi

    written: object
    if to == "c":
        from bufgym.robot import c as header

        refuse(given(weights), "belongs to --to safetensors")
        policy = policies.load(model) if model.endswith(".safetensors") else policies.get(model)
        value = qoi.load(c.value or "exponential:0.618")
        written = header.write(policy, out, c.capacity or 16, value, c.max_bytes)
    else:
        from bufgym import sb3

        refuse(given(c), "belongs to --to c")
        if weights.name is None:
            raise BufgymError("--name must be given: the policy's name")
        written = sb3.export(model, out, name=weights.name, about=weights.about or "")
    print(f"wrote {written}")


def dataset(
    *,
    env: str | None = None,
    suite: str | None = None,
    split: str = "train",
    kind: str = "expert",
    policy: str = "afr",
    episodes: Seeds = 100,
    capacity: Count = 8,
    seed: Natural = 0,
    option: list[str] | None = None,
    no_regret: bool = False,
    name: str | None = None,
    out: str | None = None,
) -> None:
    """Record episodes and write them as a Minari data set.

    Args:
        env: Environment of one queue (default: Uplink-v0).
        suite: Instead: the episodes of this suite.
        split: Of the suite.
        kind: expert, medium, mixed or random.
        policy: The policy of medium and mixed.
        episodes: How many.
        capacity: L, messages.
        seed: Of the batch.
        option: Further arguments of the environment, NAME=VALUE.
        no_regret: Leave out each decision's regret: faster, and for any sizes.
        name: Id of the data set (default: bufgym/ENVIRONMENT/KIND-v0).
        out: Folder of data sets (default: Minari's own).
    """
    from bufgym.envs.expert import dataset as sets

    if suite is not None and env is not None:
        raise BufgymError("--suite and --env: give one of them")
    further = dict(_setting(text) for text in option or ())
    if suite is not None:
        further |= {"suite": suite, "split": split}
    made = sets.make(
        "bufgym/Suite-v0" if suite is not None else env or "bufgym/Uplink-v0",
        kind,
        episodes,
        name=name,
        out=out,
        medium=policy,
        seed=seed,
        regret=not no_regret,
        capacity=capacity,
        **further,
    )
    print(f"wrote {made}: {episodes} episodes; minari.load_dataset({made!r})")


def _setting(text: str) -> tuple[str, Any]:
    """Parse ``"t_max=60"`` to ("t_max", 60); a value that is not JSON stays text."""
    name, sign, value = text.partition("=")
    if not (name.isidentifier() and sign):
        raise BufgymError(f"--option {text}: must be NAME=VALUE")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value

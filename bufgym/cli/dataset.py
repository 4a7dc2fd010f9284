"""``bufgym dataset make``: episodes as a data set."""

import json
from typing import Any

from bufgym.cli.options import Count, Natural, Seeds
from bufgym.utils.errors import BufgymError


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
        env: Environment of one queue (default: Uplink-v1).
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
        "bufgym/Suite-v1" if suite is not None else env or "bufgym/Uplink-v1",
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

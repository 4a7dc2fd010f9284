"""The parts of a suite: a name, scenarios in three splits, capacities, and a number of episodes."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bufgym.utils.errors import BufgymError

SPLITS = ("train", "validation", "test")

CAPACITIES = (5, 10, 15, 20, 25)
"""L of AFR's evaluation (Fig. 7, 8)."""


@dataclass(frozen=True)
class Setting:
    """One scenario of a suite, for one split."""

    scenario: Any
    """A ``Scenario``; for a suite of fleets a ``FleetScenario``."""
    about: str
    """Description in one line without a full stop."""
    outage_s: float | None = None
    """Length of the episode's one blackout, s; None without one of a known length."""
    max_bytes: int | None = None
    """B of every sender, bytes; None for no limit."""
    capacities: tuple[int, ...] = ()
    """L of this scenario, messages; empty for the suite's."""


Build = Callable[[str, Path], dict[str, Setting]]
"""(split, folder of recordings, which only a suite that ``needs`` one looks at) -> settings by label."""


@dataclass(frozen=True)
class Suite:
    """A named set of episodes that results are quoted on."""

    name: str
    """Name with its version, such as ``lte-v1``."""
    about: str
    """Description in one line without a full stop."""
    build: Build
    """Makes the scenarios of a split; ``settings`` calls it and keeps the result."""
    capacities: tuple[int, ...] = CAPACITIES
    """L, messages; for a fleet, L of each robot."""
    seeds: int = 5
    """Episodes on each trace."""
    needs: str = ""
    """Required contents of a folder of recordings; empty if the suite needs none."""
    kind: str = "queue"
    """Task of its scenarios: a name in ``bufgym.benchmark.tasks``."""
    first_seeds: Mapping[str, int] = field(default_factory=dict)
    """The first seed of each split, where splits share their scenarios; by default 0."""
    source: str = ""
    """``module:NAME`` of one's own suite; empty for any other."""

    @property
    def own(self) -> bool:
        """Whether it is one's own."""
        return bool(self.first_seeds)

    def settings(self, split: str, data: str | Path | None = None) -> dict[str, Setting]:
        """The scenarios of one split by label; ``data`` is the folder of recordings, for suites that need one.

        Raises:
            BufgymError: for another split, or recordings that are missing.
        """
        if split not in SPLITS:
            raise BufgymError(f"split = {split!r}: must be one of {', '.join(SPLITS)}")
        if self.needs and data is None:
            raise BufgymError(f"suite {self.name} needs a folder of recordings (--data DIR) with {self.needs}")
        return _built(self.build, split, Path(data or ""))


@functools.lru_cache(maxsize=16)
def _built(build: Build, split: str, data: Path) -> dict[str, Setting]:
    return build(split, data)

"""The scenarios of a suite as one: ``bufgym/Suite-v1``."""

import functools
from dataclasses import dataclass
from typing import ClassVar

from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.scenario import suites
from bufgym.scenario.episode import Episode, Scenario, Streams
from bufgym.utils.errors import BufgymError


@dataclass(frozen=True)
class SuiteScenario:
    """Every episode is of one of the scenarios in a split of a suite, all equally likely.

    Episodes have the V of their own scenario. Only suites of one queue are allowed.
    """

    suite: str = "lte-v1"  # its name
    split: str = "train"  # "train", "validation" or "test"
    data: str | None = None  # folder of recordings, for suites that need one

    topics: ClassVar[tuple[Topic, ...]] = ()  # empty: one queue

    def __post_init__(self) -> None:
        suite = suites.get(self.suite)
        if suite.kind != "queue":
            raise BufgymError(
                f"suite {suite.name} is one of {suite.kind}: bufgym/Suite-v1 has those of one queue alone"
            )
        if self.split not in suites.SPLITS:
            raise BufgymError(f"split = {self.split!r}: must be one of {', '.join(suites.SPLITS)}")

    @functools.cached_property
    def members(self) -> dict[str, Scenario]:
        """The scenarios by label."""
        settings = suites.get(self.suite).settings(self.split, self.data)
        return {label: setting.scenario for label, setting in settings.items()}

    @property
    def about(self) -> str:
        """The suite and the split."""
        return f"Scenarios of the suite {self.suite}, {self.split}: {', '.join(self.members)}."

    @property
    def value(self) -> Value:
        """V of the first scenario; every episode brings its own."""
        return next(iter(self.members.values())).value

    @property
    def max_messages(self) -> int:
        """Arrivals of the longest episode of all."""
        return max(member.max_messages for member in self.members.values())

    def draw(self, streams: Streams) -> Episode:
        """Draw one episode."""
        members = list(self.members.values())
        member = members[int(streams.link.integers(len(members)))]
        return member.draw(streams).valued(member.value)

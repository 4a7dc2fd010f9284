"""The protocol of a task, and how an episode is drawn for any of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from bufgym.benchmark.rows import Layout, Row
from bufgym.benchmark.summary import Quantity, Summary
from bufgym.errors import BufgymError
from bufgym.policies import Policy
from bufgym.scenario.suites import Setting

Result = list[Row]
"""The rows of one run, without what ``run`` adds: scenario, trace, seed, policy and capacity."""


@dataclass(frozen=True)
class Task(ABC):
    """One kind of experiment: every policy on the same episodes, and what is said of the rows."""

    kind: ClassVar[str]
    """Its name: ``Suite.kind``."""
    scenarios: ClassVar[tuple[type, ...]]
    """The classes of its scenarios."""
    layout: ClassVar[Layout]
    """The columns of its rows."""
    needed: ClassVar[tuple[str, ...]]
    """The columns that a report cannot do without."""
    baseline: ClassVar[str]
    """The policy that the others are measured against; it always runs."""
    reference: ClassVar[str]
    """The policy that a row of the leaderboard is compared with besides."""
    listed: ClassVar[tuple[str, ...]]
    """Quantities that the leaderboard lists, by key."""
    no_plan: ClassVar[str] = ""
    """Why a privileged policy can't take part: what it plans with; empty if it can."""
    legend: ClassVar[tuple[str, ...]] = ()
    """Lines under a printed summary."""

    @abstractmethod
    def default_policies(self, suite: str) -> list[str]:
        """The policies that run on a suite unless the caller says otherwise."""

    def check(self, policy: Policy) -> None:
        """An error for a policy that can't take part."""
        if policy.privileged is not None and self.no_plan:
            raise BufgymError(f"policy {policy.name}: it plans with {self.no_plan}")

    def verify(self, policy: Policy, row: Row) -> None:
        """An error for a row that cannot be true."""
        return None

    def messages(self, scenario: Any) -> int:
        """How many messages the senders of one episode hold at most."""
        return int(scenario.max_messages)

    def rows_per_run(self, scenario: Any) -> int:
        """How many rows one run makes."""
        return 1

    @abstractmethod
    def play(
        self, policies: Sequence[Policy], scenario: Any, episodes: Sequence[Any], capacity: int
    ) -> Iterator[list[Result]]:
        """For each policy in turn, the result of each episode."""

    @abstractmethod
    def quantities(self) -> tuple[Quantity, ...]:
        """What its summary shows of each policy."""

    @abstractmethod
    def summary(self, rows: Sequence[Row], unranked: Collection[str] = (), **options: Any) -> Summary:
        """Every policy beside the baseline.

        Args:
            rows: of ``run``.
            unranked: policies that are shown but not ranked.
            options: ``resamples``, ``confidence`` and ``seed``, as in ``summarise``.
        """

    def senders(self, rows: Sequence[Row]) -> Sequence[Row]:
        """One row for each sender: for what all rows of a sender repeat."""
        return rows

    def describe(self, scenarios: Sequence[Any], episodes: int) -> str:
        """What the policies meet, in one sentence; empty where the scenarios' own descriptions say it."""
        return ""

    def example(
        self, policies: Sequence[Policy], rows: Sequence[Row], setting_of: Callable[[Row], Setting]
    ) -> dict[str, Any] | None:
        """One episode in full for the report, as JSON holds it; None where the task has no such chart.

        ``setting_of`` gives the setting of a row, its scenario on that row's trace alone.
        """
        return None


def counted(n: int, thing: str) -> str:
    """``"1 link"``, ``"2 links"``."""
    return f"{n} {thing}{'' if n == 1 else 's'}"

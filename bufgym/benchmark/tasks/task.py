"""Protocol of a task."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from bufgym.benchmark.rows import Layout, Row
from bufgym.benchmark.summary import Quantity, Summary, table_of
from bufgym.benchmark.table import NOBODY, Table, Unranked, invalid
from bufgym.policies import Policy
from bufgym.scenario import about
from bufgym.scenario.suites import Setting
from bufgym.utils.errors import BufgymError

Result = list[Row]
"""Rows of one run without scenario, trace, seed, policy and capacity, which ``run`` adds."""


@dataclass(frozen=True)
class Task(ABC):
    """One kind of experiment: it plays every policy on the same episodes and summarizes the rows."""

    kind: ClassVar[str]  # its name: ``Suite.kind``
    scenarios: ClassVar[tuple[type, ...]]  # the classes of its scenarios
    layout: ClassVar[Layout]  # the columns of its rows
    needed: ClassVar[tuple[str, ...]]  # columns that a report needs
    baseline: ClassVar[str]  # the policy that the others are measured against; it always runs
    reference: ClassVar[str]  # second policy that a row of the leaderboard is compared with
    listed: ClassVar[tuple[str, ...]]  # quantities that the leaderboard lists, by key
    no_plan: ClassVar[str] = ""  # reason why a privileged policy can't take part; empty if it can
    capacity: ClassVar[int] = 8  # L unless the caller says otherwise, messages
    seeds: ClassVar[int] = 10  # episodes on each trace, likewise
    legend: ClassVar[tuple[str, ...]] = ()  # lines under a printed summary
    shows_baseline: ClassVar[bool] = True  # whether tables and rows have the baseline where nobody named it

    @abstractmethod
    def default_policies(self) -> list[str]:
        """The policies that run unless the caller says otherwise."""

    def check(self, policy: Policy) -> None:
        """Raise an error for a policy that can't take part."""
        if policy.privileged is not None and self.no_plan:
            raise BufgymError(f"policy {policy.name}: it plans with {self.no_plan}")

    def verify(self, policy: Policy, row: Row) -> None:
        """Raise an error for a row that cannot be true."""
        return None

    def messages(self, scenario: Any) -> int:
        """Most messages that the senders of one episode hold."""
        return int(scenario.max_messages)

    def rows_per_run(self, scenario: Any) -> int:
        """Number of rows that one run makes."""
        return 1

    @abstractmethod
    def play(
        self, policies: Sequence[Policy], scenario: Any, episodes: Sequence[Any], capacity: int
    ) -> Iterator[list[Result]]:
        """Yield for each policy in turn the results of all episodes."""

    @abstractmethod
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities that its summary shows."""

    @abstractmethod
    def summary(self, rows: Sequence[Row], unranked: Unranked = NOBODY, against: str = "") -> Summary:
        """Compare every policy with the baseline, and with ``against`` in a further quantity of that name."""

    def senders(self, rows: Sequence[Row]) -> Sequence[Row]:
        """Select one row for each sender, for columns that all rows of a sender repeat."""
        return rows

    def notes(self, rows: Sequence[Row], summary: Summary) -> list[str]:
        """Lines under a printed summary: the legend, who has no rank, invalid decisions, and the summary's own."""
        no_rank = [f"{s.policy} has no rank: {s.unranked_because}." for s in summary.overall if not s.ranked]
        return [*self.legend, *no_rank, *invalid(self.senders(rows)), *summary.notes]

    def tables(
        self, rows: Sequence[Row], summary: Summary, scenario: Any, unranked: Unranked, hidden: str
    ) -> list[Table]:
        """Tables of one scenario's rows; the policy ``hidden`` gets no line of its own in the first."""
        abouts = {rows[0]["scenario"]: about(scenario)}
        return [table_of(summary, abouts, ["", *self.notes(rows, summary)])]

    def describe(self, scenarios: Sequence[Any], episodes: int) -> str:
        """Describe the scenarios in one sentence; empty if their own descriptions do."""
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

"""One queue: every policy is scored between Drop Oldest at 0 and the clairvoyant at 1."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from bufgym.benchmark.rows import RUNS, Row
from bufgym.benchmark.score import scores
from bufgym.benchmark.summary import Quantity, Standing, Summary
from bufgym.benchmark.table import REGRET_AT_MOST, percent, score
from bufgym.benchmark.tasks import bound, timeline
from bufgym.benchmark.tasks.task import Result, Task
from bufgym.benchmark.tuned import tuned
from bufgym.ground.errors import BufgymError
from bufgym.oracle.measure import BASELINE, TIE
from bufgym.policies import Policy, names
from bufgym.scenario import Episode
from bufgym.scenario.suites import Setting
from bufgym.sim.metrics import outcome


@dataclass(frozen=True)
class QueueTask(Task):
    """One camera's messages in one queue; one row for each run."""

    max_bytes: int | None = None
    """B, bytes; None for no limit."""
    decide_at: str = "arrival"
    """"arrival", or "overflow" to ask only when the buffer is full."""
    bound: bool = True
    """Whether to find the clairvoyant's H for every episode and capacity, and every policy's regret."""

    kind = "queue"
    scenarios = ()  # any that no other task claims
    layout = RUNS
    needed = ("scenario", "trace", "seed", "capacity", "policy", "qoi", "mean_sojourn_s", "mean_age_s")
    baseline = BASELINE
    reference = "afr"
    listed = ("score", "regret", "improvement")

    def default_policies(self, suite: str) -> list[str]:
        """List all policies for one queue with their sources' parameters, and the variants tuned on the suite."""
        return [*names(for_topics=False), *tuned(suite)]

    def check(self, policy: Policy) -> None:
        if policy.privileged is not None and self.decide_at != "arrival":
            raise BufgymError(
                f"policy {policy.name}: it plans for a sender that asks at every arrival, not with decide_at = "
                f"{self.decide_at!r}; its H is an upper bound there"
            )

    def verify(self, policy: Policy, row: Row) -> None:
        best = row["clairvoyant"]
        if best is not None and not policy.unbounded and row["qoi"] > best * (1 + TIE):
            place = f"policy {row['policy']}, L = {row['capacity']}, trace {row['trace']}, seed {row['seed']}"
            raise BufgymError(f"{place}: H = {row['qoi']:.12g} is above {best:.12g}, which no policy can reach")

    def play(
        self, policies: Sequence[Policy], scenario: Any, episodes: Sequence[Episode], capacity: int
    ) -> Iterator[list[Result]]:
        settings = self.max_bytes, self.decide_at
        plans = [bound.best(e, capacity, scenario, *settings) if self.bound else None for e in episodes]
        for policy in policies:
            senders = bound.meet(policy, episodes, capacity, scenario, plans, *settings)
            outcomes = [outcome(senders, i) for i in range(len(episodes))]
            yield [
                [{**asdict(result), **bound.columns(policy, result.qoi, plan)}]
                for result, plan in zip(outcomes, plans, strict=True)
            ]

    def quantities(self, reference: str = "afr") -> tuple[Quantity, ...]:
        means = "It is the mean over the discriminative cells"
        scale = f"0 is Drop Oldest and 1 the clairvoyant, which no policy can pass. {means}"
        above = f"share of episodes with a larger H than under {reference}. Equal episodes count one half"
        return (
            Quantity("score", "score", score, scale, drawn=True),
            Quantity("iqm", "IQM", score, "interquartile mean of the scores on each discriminative cell and trace"),
            Quantity("regret", "regret", percent, f"share of the clairvoyant's H that was lost. {means}"),
            Quantity("improvement", f"better than {reference}", score, above, versus=reference, drawn=True),
        )

    def summary(self, rows: Sequence[Row], unranked: Collection[str] = (), **options: Any) -> Summary:
        scored = scores(rows, unranked=unranked, **options)
        quantities = self.quantities(scored.reference)
        if not scored.exact:
            quantities = tuple(q._replace(title=REGRET_AT_MOST) if q.key == "regret" else q for q in quantities)
        overall = [
            Standing(s.policy, s.ranked, {quantity.key: getattr(s, quantity.key) for quantity in quantities})
            for s in scored.standings
        ]
        return Summary(quantities, "score", overall, {}, scored.baseline, scored.confidence, scored.resamples, scored)

    def example(
        self, policies: Sequence[Policy], rows: Sequence[Row], setting_of: Callable[[Row], Setting]
    ) -> dict[str, Any] | None:
        row = timeline.choose(rows)
        if row is None:
            return None
        setting = setting_of(row)
        return {**timeline.timeline(policies, setting.scenario, row), "about": setting.about}

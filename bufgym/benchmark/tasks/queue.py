"""One queue: every policy is scored between Drop Oldest at 0 and the clairvoyant at 1."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import zip_longest
from typing import Any

import numpy as np

from bufgym import policies as registry
from bufgym.benchmark import bootstrap, table
from bufgym.benchmark.rows import RUNS, Row
from bufgym.benchmark.score import REFERENCE, scores
from bufgym.benchmark.summary import Quantity, Summary, difference, table_over
from bufgym.benchmark.table import NOBODY, REGRET_AT_MOST, Table, Unranked, percent, score
from bufgym.benchmark.tasks.task import Result, Task
from bufgym.oracle import Plan, clairvoyant
from bufgym.oracle.clairvoyant import privileged
from bufgym.oracle.measure import BASELINE, TIE, regret
from bufgym.policies import Policy
from bufgym.scenario import Episode, Scenario
from bufgym.scenario.numbered import draw
from bufgym.scenario.suites import Setting
from bufgym.sim import NEVER, Senders, run
from bufgym.sim.metrics import outcome
from bufgym.sim.senders import padded
from bufgym.utils.errors import BufgymError

SHARE = f"regret / {REFERENCE}'s"  # Title of the share of AFR's regret, see ``score``


def columns(policy: Policy, h: float, plan: Plan | None) -> Row:
    """Columns of a row besides the policy's ``Outcome``: clairvoyant, certified and regret, see ``rows.RUNS``."""
    if plan is None:
        return {"clairvoyant": None, "certified": None, "regret": None}
    lost = None if policy.unbounded else regret(h, plan.qoi)
    return {"clairvoyant": plan.qoi, "certified": plan.certified, "regret": lost}


@dataclass(frozen=True)
class QueueTask(Task):
    """One camera's messages in one queue; one row for each run."""

    max_bytes: int | None = None  # B, bytes; None for no limit
    decide_at: str = "arrival"  # or "overflow" to ask only when the buffer is full
    bound: bool = True  # whether to find the clairvoyant's H for every episode and capacity, and every policy's regret

    kind = "queue"
    scenarios = ()  # any that no other task claims
    layout = RUNS
    needed = ("scenario", "trace", "seed", "capacity", "policy", "qoi", "mean_sojourn_s", "mean_age_s")
    baseline = BASELINE
    reference = REFERENCE
    listed = ("score", "regret", "improvement")
    shows_baseline = False

    def default_policies(self) -> list[str]:
        """All policies for one queue with their sources' parameters."""
        able = list(registry.names(for_topics=False))
        if self.decide_at != "arrival":  # see ``check``
            able = [name for name in able if registry.get(name).privileged is None]
        return able

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

    def best(self, episode: Episode, capacity: int, scenario: Scenario) -> Plan:
        """Compute the clairvoyant's plan, which is only an upper bound if decisions wait for a full buffer."""
        plan = clairvoyant(episode, capacity, scenario.value, max_bytes=self.max_bytes)
        return plan if self.decide_at == "arrival" or plan.kept.all() else replace(plan, certified=False)

    def meet(
        self, policy: Policy, episodes: Sequence[Episode], capacity: int, scenario: Scenario, plans: Sequence[Plan] = ()
    ) -> Senders:
        """Run ``policy`` on the episodes and return the senders; the clairvoyant reuses known plans."""
        memory = padded([plan.kept for plan in plans]) if plans and policy.privileged is privileged else None
        return run(
            policy,
            episodes,
            capacity,
            scenario.value,
            max_bytes=self.max_bytes,
            decide_at=self.decide_at,
            memory=memory,
        )

    def play(
        self, policies: Sequence[Policy], scenario: Any, episodes: Sequence[Episode], capacity: int
    ) -> Iterator[list[Result]]:
        least = min((e.arrivals["size_bytes"].min() for e in episodes if len(e.arrivals)), default=0)
        if self.max_bytes is not None and least > self.max_bytes:
            raise BufgymError(f"max_bytes = {self.max_bytes}: no message fits, the smallest has {least} bytes")
        plans = [self.best(episode, capacity, scenario) for episode in episodes] if self.bound else []
        for policy in policies:
            senders = self.meet(policy, episodes, capacity, scenario, plans)
            outcomes = [outcome(senders, i) for i in range(len(episodes))]
            yield [
                [{**asdict(result), **columns(policy, result.qoi, plan)}]
                for result, plan in zip_longest(outcomes, plans)
            ]

    def quantities(self) -> tuple[Quantity, ...]:
        means = "It is the mean over the discriminative cells"
        scale = f"0 is Drop Oldest and 1 the clairvoyant, which no policy can pass. {means}"
        share = f"sum over the discriminative cells of the regrets, divided by that of {REFERENCE}: a ratio of sums"
        above = f"share of episodes with a larger H than under {REFERENCE}. Equal episodes count one half"
        return (
            Quantity("score", "score", score, scale, drawn=True),
            Quantity("iqm", "IQM", score, "interquartile mean of the scores on each discriminative cell and trace"),
            Quantity("regret", "regret", percent, f"share of the clairvoyant's H that was lost. {means}"),
            Quantity("share", SHARE, score, share, versus=REFERENCE),
            Quantity("improvement", f"better than {REFERENCE}", score, above, versus=REFERENCE, drawn=True),
        )

    def summary(self, rows: Sequence[Row], unranked: Unranked = NOBODY, against: str = "") -> Summary:
        scored = scores(rows, unranked, against)
        quantities = (*self.quantities(), *([difference(SHARE, against)] if against else []))
        if not scored.exact:
            quantities = tuple(q._replace(title=REGRET_AT_MOST) if q.key == "regret" else q for q in quantities)
        return Summary(quantities, "score", scored.standings, {}, self.baseline, scored, scored.remarks)

    def tables(
        self, rows: Sequence[Row], summary: Summary, scenario: Any, unranked: Unranked, hidden: str
    ) -> list[Table]:
        """The table of means; then, where policies are compared with one of them, their shares of AFR's regret."""
        cells = [cell for cell in summary.scores.cells if not math.isnan(cell.score.value)] if summary.scores else []
        texts = {(c.capacity, c.policy): bootstrap.written(c.score, score)[: min(c.episodes, 2)] for c in cells}
        means = table.means_table(rows, unranked, {place: " ".join(text) for place, text in texts.items()}, hidden)
        scale = [table.SCORE, *[table.BRACKETS] * any(c.episodes > 1 for c in cells)] if "score" in means.head else []
        means = means._replace(notes=[*scale, *means.notes, *self._bound_notes(rows, scenario), *summary.notes])
        paired = [quantity for quantity in summary.quantities if quantity.key in ("share", "against")]
        if len(paired) == 1:
            return [means]
        notes = [f"{quantity.title}: {quantity.about}." for quantity in paired]
        return [means, table_over([("", summary.overall)], paired)._replace(notes=notes)]

    def _bound_notes(self, rows: Sequence[Row], scenario: Any) -> list[str]:
        """State the clairvoyant's result on a recording, and whether it is exact."""
        workload = getattr(scenario, "workload", None)
        if workload is None or not self.bound:
            return []
        equal_sizes = workload.size_bytes.min() == workload.size_bytes.max()
        why = f"decisions are asked at {self.decide_at}" if equal_sizes else "message sizes differ"
        notes = []
        for capacity in dict.fromkeys(row["capacity"] for row in rows):
            episodes = {(row["trace"], row["seed"]): row for row in rows if row["capacity"] == capacity}.values()
            most = sum(row["clairvoyant"] for row in episodes) / len(episodes)
            exact = all(row["certified"] for row in episodes)
            what = f"is {most:.3f}" if exact else f"is at most {most:.3f}, an upper bound, as {why}"
            notes.append(f"note: L = {capacity}: the clairvoyant's QoI {what}; regret is measured against it")
        if any(row["policy"] == "clairvoyant" and not row["certified"] for row in rows):
            notes.append(
                "note: the row clairvoyant follows a plan for which there is not always room: less than its bound"
            )
        return notes

    def example(
        self, policies: Sequence[Policy], rows: Sequence[Row], setting_of: Callable[[Row], Setting]
    ) -> dict[str, Any] | None:
        row = row_to_show(rows)
        if row is None:
            return None
        setting = setting_of(row)
        return {**self.timeline(policies, setting.scenario, row), "about": setting.about}

    def timeline(self, policies: Sequence[Policy], scenario: Scenario, row: Row) -> dict[str, Any]:
        """The episode of ``row`` under every policy; times in s, rates in bytes/s."""
        episode, capacity = draw(scenario, row["seed"]), row["capacity"]
        plan = self.best(episode, capacity, scenario)
        arrivals = np.asarray(episode.arrivals)
        lanes: dict[str, Any] = {}
        last_us = int(arrivals["arrival_us"][-1])
        for policy in policies:
            senders = self.meet(policy, [episode], capacity, scenario, [plan])
            log = np.asarray(senders.batch.log[0])[: len(arrivals)]
            h = outcome(senders, 0).qoi
            received = np.flatnonzero(log["transmitted_us"] != NEVER)
            dropped = np.flatnonzero(log["dropped_us"] != NEVER)
            lanes[policy.name] = {
                "qoi": h,
                "regret": columns(policy, h, plan)["regret"],
                "received": [
                    [int(k), int(log["dequeued_us"][k]) / 1e6, int(log["transmitted_us"][k]) / 1e6] for k in received
                ],
                "dropped": [[int(k), int(log["dropped_us"][k]) / 1e6] for k in dropped],
            }
            if policy.ranked and len(received):
                last_us = max(last_us, int(log["transmitted_us"][received].max()))
        edges_us = np.arange(0, last_us + round(2e6 * _STEP_S), round(1e6 * _STEP_S))
        carried = np.diff(episode.link.carried_by(edges_us))
        offered_s = max(1, int(arrivals["arrival_us"][-1])) / 1e6
        return {
            **{key: row[key] for key in ("scenario", "capacity", "trace", "seed")},
            "arrival_s": (arrivals["arrival_us"] / 1e6).tolist(),
            "x": arrivals["x"].tolist(),
            "rate": {"t_s": (edges_us[:-1] / 1e6).tolist(), "bytes_per_s": (carried / _STEP_S).tolist()},
            "demand_bytes_per_s": float(arrivals["size_bytes"][:-1].sum() / offered_s),
            "policies": lanes,
        }


_STEP_S = 0.25  # between the points of the curve of the link's capacity


def row_to_show(rows: Sequence[Row]) -> Row | None:
    """The row of the episode to show: at the middle capacity, the one on which Drop Oldest has the largest regret."""
    capacities = sorted({row["capacity"] for row in rows})
    middle = capacities[len(capacities) // 2]
    candidates = [
        row for row in rows if row["policy"] == BASELINE and row["capacity"] == middle and row["regret"] is not None
    ]
    return max(candidates, key=lambda row: (row["regret"], row["scenario"], row["trace"], row["seed"]), default=None)

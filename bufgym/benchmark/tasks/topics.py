"""Several topics of one client over one uplink: every policy beside Robofleet's client as published."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from bufgym.benchmark.bootstrap import NOT_NEGATIVE, SHARES, ratio
from bufgym.benchmark.episodes import Numbers
from bufgym.benchmark.rows import Layout, Row, columns_of
from bufgym.benchmark.summary import KEY, Quantity, Summary, by_run, summarise, title
from bufgym.benchmark.table import NOBODY, Column, RunRows, Unranked, decimal, mean, percent, score
from bufgym.benchmark.tasks.task import Result, Task, counted
from bufgym.policies import Policy, names
from bufgym.scenario import Client, Episode
from bufgym.sim import Senders, run
from bufgym.sim.metrics import TopicOutcome, received, topic_outcomes, weighted_qoi
from bufgym.utils.errors import BufgymError
from bufgym.utils.tables import Table

BASELINE = "robofleet"
"""Robofleet's client as published."""

_RIVALS = ("drop-oldest", "rosbridge")  # made for one queue, but what a robot's topics meet today

_OUTCOME = {name: float for name in columns_of(TopicOutcome) if name != "topic"} | {"arrived": int}

ROWS: Layout = {
    **{"scenario": str, "trace": str, "seed": int, "window": int, "consumers": int, "policy": str, "capacity": int},
    **{"topic": str, "priority": float, "weight": float, "no_drop": bool, "deadline_s": float},
    **_OUTCOME,
    **{"weighted_qoi": float, "seconds": float, "invalid": int},
}
"""One row for each topic of a run.

It has the rules of the topic (``deadline_s`` is None where it has none) and its ``TopicOutcome`` (means over the
consumers where each gets a copy of its own, so not always whole numbers). Of the run as a whole it has
``weighted_qoi``, the sum of weight x H over the topics; ``seconds``, its length until the last arrival or the last
receipt, whichever is later; and ``invalid``, the decisions that could not be carried out.
"""


@dataclass(frozen=True)
class TopicsTask(Task):
    """A client whose topics share one buffer and one uplink."""

    kind = "topics"
    scenarios = (Client,)
    layout = ROWS
    needed = tuple(ROWS)
    baseline = BASELINE
    reference = BASELINE
    listed = ("relative", "lost", "age_relative")
    capacity = 32
    seeds = 5
    no_plan = "a queue of its own, which no topic of a client has"
    legend = (
        "QoI: sum over topics of weight x H, mean over episodes; [low, high]: 95 % intervals, resampling links.",
        "no_drop lost: messages, all episodes together. Age: of information, at the server, mean over topics and time.",
        "Late: of what was delivered on topics with a deadline. Delivered a second: until the last arrival or receipt.",
        "The QoI of an unbounded queue counts messages that arrive long after the others.",
    )

    def default_policies(self) -> list[str]:
        """List all policies for topics, and the common policies that ignore topics."""
        return [*_RIVALS, *names(for_topics=True)]

    def messages(self, scenario: Client) -> int:
        return scenario.max_messages * scenario.consumers

    def rows_per_run(self, scenario: Client) -> int:
        return len(scenario.topics)

    def play(
        self, policies: Sequence[Policy], scenario: Client, episodes: Sequence[Episode], capacity: int
    ) -> Iterator[list[Result]]:
        for policy in policies:
            senders = run(policy, episodes, capacity, scenario.value, topics=scenario.topics)
            yield [_rows(scenario, senders, i) for i in range(len(episodes))]

    def quantities(self, first: str = "first") -> tuple[Quantity, ...]:
        """List the quantities; ``first`` names the topics of the highest priority."""

        paired = "Both are sums over the episodes that both met; over several settings it is the mean of these ratios"
        first_age = "mean age of information at the server of the topics with the highest priority, s"
        relative_age = f"age of the topics with the highest priority, divided by their age under {BASELINE}. {paired}"
        others_age = "mean age of information of all other topics, s"
        lost = "messages of no_drop topics that were dropped, in all episodes together"
        late = "share of messages delivered after their deadline, among all delivered on topics with a deadline"
        rate = "messages delivered a second, until the last arrival or receipt"
        return (
            Quantity(
                "qoi",
                "QoI",
                _one_digit,
                "sum over topics of weight x H, mean over episodes",
                interval=False,
                within=NOT_NEGATIVE,
            ),
            Quantity(
                "relative",
                f"QoI / {BASELINE}",
                score,
                f"QoI divided by {BASELINE}'s QoI. {paired}",
                drawn=True,
                within=NOT_NEGATIVE,
            ),
            Quantity(
                "lost",
                "no_drop lost",
                lambda number: f"{round(number, 1):g}",
                lost,
                interval=False,
                total=True,
                within=NOT_NEGATIVE,
            ),
            Quantity("age_first_s", f"age, {first} (s)", _seconds, first_age, interval=False, within=NOT_NEGATIVE),
            Quantity("age_relative", f"age / {BASELINE}", score, relative_age, drawn=True, within=NOT_NEGATIVE),
            Quantity("age_others_s", "age, others (s)", _seconds, others_age, within=NOT_NEGATIVE),
            Quantity("late", "late", percent, late, interval=False, within=SHARES),
            Quantity("rate_hz", "msg/s", _one_digit, rate, interval=False, within=NOT_NEGATIVE),
        )

    def summary(self, rows: Sequence[Row], unranked: Unranked = NOBODY, against: str = "") -> Summary:
        runs = by_run(rows, "topic", "weighted_qoi")
        priorities = {max(row["priority"] for row in run.values()) for run in runs.values()}
        first = f"priority {priorities.pop():g}" if len(priorities) == 1 else "first"
        numbers = {key: _numbers(list(run.values())) for key, run in runs.items()}
        options: Any = {"rank_by": "relative", "baseline": self.baseline, "unranked": unranked, "against": against}
        return summarise(numbers, _statistics, self.quantities(first), **options)

    def senders(self, rows: Sequence[Row]) -> Sequence[Row]:
        return list({tuple(row[name] for name in KEY): row for row in rows}.values())

    def describe(self, scenarios: Sequence[Client], episodes: int) -> str:
        client, many = scenarios[0], counted(episodes, "episode")
        windows = " and ".join(f"{n}" for n in dict.fromkeys(client.window for client in scenarios))
        acks = f"acks {client.ack_delay_us / 1000:g} ms after a message is transmitted"
        consumers = counted(client.consumers, "consumer")
        return f"{many} of {client.duration_s:g} s; n_T = {windows}, {acks}, {consumers}."


def _rows(client: Client, senders: Senders, i: int) -> Result:
    sender, messages = np.asarray(senders.batch.senders)[i], received(senders, i)
    log = np.asarray(senders.batch.log[i])
    last_us = int(np.asarray(senders.batch.arrivals[i])["arrival_us"][sender["arrivals"] - 1])
    if len(messages):
        last_us = max(last_us, int(log["transmitted_us"][messages["seq"][-1]] + sender["propagation_us"]))
    of_the_run = {
        "window": client.window,
        "consumers": client.consumers,
        "weighted_qoi": weighted_qoi(senders, i, messages),
        "seconds": last_us / 1e6,
        "invalid": int(sender["invalid"]),
    }
    outcomes = topic_outcomes(senders, i)
    return [
        {
            "topic": topic.name,
            "priority": float(topic.priority),
            "weight": float(topic.share),
            "no_drop": topic.no_drop,
            "deadline_s": None if topic.deadline_s is None else float(topic.deadline_s),
            # Where each consumer gets a copy, copy c of topic k is topic c x (number of topics) + k.
            **_folded(outcomes[k :: len(client.topics)]),
            **of_the_run,
        }
        for k, topic in enumerate(client.topics)
    ]


def _folded(copies: Sequence[TopicOutcome]) -> Row:
    outcomes = [asdict(copy) for copy in copies]
    means: Row = {name: mean([outcome[name] for outcome in outcomes]) for name in _OUTCOME}
    return {**means, "arrived": int(means["arrived"])}


_seconds, _one_digit = (partial(decimal, digits=digits) for digits in (2, 1))


def _numbers(topics: RunRows) -> list[float]:
    """Numbers of one run for ``_statistics``: QoI, no_drop messages lost, age of the first topics and of the others,
    messages late, delivered with a deadline and delivered in all, seconds."""
    highest = max(row["priority"] for row in topics)
    with_deadline = [row for row in topics if row["deadline_s"] is not None]
    return [
        topics[0]["weighted_qoi"],
        sum(row["lost"] + row["limited"] for row in topics if row["no_drop"]),
        mean([row["mean_age_s"] for row in topics if row["priority"] == highest]),
        mean([row["mean_age_s"] for row in topics if row["priority"] < highest]),
        sum(row["late"] for row in with_deadline),
        sum(row["delivered"] for row in with_deadline),
        sum(row["delivered"] for row in topics),
        topics[0]["seconds"],
    ]


def _statistics(ours: Numbers, base: Numbers, weights: Numbers) -> dict[str, Numbers]:
    """See ``summary.Statistics``."""

    def share(above: Numbers, below: Numbers) -> Numbers:
        total = weights @ below
        return ratio(weights @ above, total, total > 0)

    def average(numbers: Numbers) -> Numbers:
        known = ~np.isnan(numbers)
        return share(np.where(known, numbers, 0.0), known.astype(np.float64))

    qoi, lost, age_first, age_others, late, due, delivered, seconds = ours.T
    return {
        "qoi": average(qoi),
        "relative": share(qoi, base.T[0]),
        "lost": weights @ lost,
        "age_first_s": average(age_first),
        "age_relative": share(age_first, base.T[2]),
        "age_others_s": average(age_others),
        "late": share(late, due),
        "rate_hz": share(delivered, seconds),
    }


TOPIC_COLUMNS = (
    Column("topic", "topic", str),
    Column("priority", "priority", "{:g}".format),
    Column("QoI", "qoi", _seconds),
    *(Column(name, name, _one_digit) for name in ("arrived", "limited", "lost", "delivered", "late")),
    Column("age mean (s)", "mean_age_s", score),
    Column("age peak (s)", "peak_age_s", score),
    Column("delay mean (s)", "mean_sojourn_s", score),
    Column("delay p95 (s)", "p95_sojourn_s", score),
)


def by_topic(rows: RunRows, policy: str) -> str:
    """Write each topic's mean outcome over episodes under one policy as aligned text, a block for each cell."""
    cells: dict[tuple[str, int], dict[str, list[Mapping[str, Any]]]] = {}
    for row in rows:
        if row["policy"] == policy:
            topics = cells.setdefault((row["scenario"], row["capacity"]), {})
            topics.setdefault(row["topic"], []).append(row)
    if not cells:
        raise BufgymError(f"no row of the policy {policy!r}")
    blocks = [
        (
            title(cell, {}),
            [
                [topic, *(c.write(mean([row[c.key] for row in outcomes])) for c in TOPIC_COLUMNS[1:])]
                for topic, outcomes in topics.items()
            ],
        )
        for cell, topics in cells.items()
    ]
    return Table([column.title for column in TOPIC_COLUMNS], blocks).plain()

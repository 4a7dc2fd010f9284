"""Replay of a live queue's log in the simulator: the same arrivals over the link that the log measured."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bufgym.jit import records as zeroed
from bufgym.model.buffer import MESSAGE
from bufgym.model.link import Link
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy, get
from bufgym.scenario import Episode
from bufgym.sim import Senders, run
from bufgym.sim.metrics import Outcome, outcome
from bufgym.sim.state import NEVER
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.log import Record, of, read_log, value_of


@dataclass(frozen=True)
class Replay:
    """Result of a replay."""

    senders: Senders
    """The single sender after its run."""
    episode: Episode
    """Arrivals, and a trace of the bytes that the link really carried."""
    differences: tuple[str, ...]
    """Decisions that differ from the live queue's, a sentence each; empty if the log is complete."""

    @property
    def outcome(self) -> Outcome:
        """Statistics of the live run."""
        return outcome(self.senders, 0)


def replay(log: str | Path | Sequence[Record], policy: Policy | None = None) -> Replay:
    """Run the messages of a log (a file, or its records) through the simulator, over the link that it measured.

    ``policy`` is needed if the registry does not know the log's policy by name.
    """
    records = log if isinstance(log, Sequence) and not isinstance(log, str) else read_log(log)
    name = "the log" if records is log else str(log)
    try:
        return _replayed(records, policy)
    except (KeyError, TypeError, IndexError, AttributeError, OverflowError) as error:
        raise BufgymError(f"{name}: no sound log of a live queue: {type(error).__name__}: {error}") from None


def _replayed(records: Sequence[Record], policy: Policy | None) -> Replay:
    made = records[0]
    if policy is None:
        policy = replace(get(made["policy"]), parameters=made["parameters"])
    topics = [Topic(**{**topic, "value": topic["value"] and value_of(topic["value"])}) for topic in made["topics"]]
    episode = Episode(_arrivals(records), Link(_trace(records)), window=made["window"], ends_us=made.get("ends_us"))
    limits = {"max_bytes": made["max_bytes"], "decide_at": made["decide_at"]}
    senders = run(policy, [episode], made["capacity"], value_of(made["v"]), topics=topics, **limits)
    return Replay(senders, episode, tuple(_differences(records, senders)))


def _arrivals(records: Sequence[Record]) -> np.ndarray[Any, Any]:
    """Arrivals of the log, MESSAGE[n]."""
    puts = list(of(records, "put"))
    arrivals = zeroed(len(puts), MESSAGE)
    for name in ("seq", "arrival_us", "size_bytes", "topic", "x", "uniform"):
        arrivals[name] = [put["us" if name == "arrival_us" else name] for put in puts]
    return arrivals


def _trace(records: Sequence[Record]) -> Trace:
    """Trace of the bytes carried, with a knot at each arrival and each departure."""
    knots = [record for record in records if "carried" in record]
    times, counts = np.array([(0, 0), (1, 0), *((record["us"], record["carried"]) for record in knots)]).T
    return Trace("live", times, counts, "stop")


def _differences(records: Sequence[Record], senders: Senders) -> list[str]:
    """Compare each message's outcome live and here; a log cut short may lack the last events."""
    log, last_us = senders.batch.log[0], records[-1]["us"]
    found = []
    for event, column in (("dequeued", "dequeued_us"), ("gone", "transmitted_us"), ("dropped", "dropped_us")):
        live = np.full(len(log), NEVER)
        for record in of(records, event):
            live[record["seq"]] = record["us"]
        found += [
            f"message {seq}: {event} at {live[seq]} us, in the simulator at {log[column][seq]} us (-1: never)"
            for seq in np.flatnonzero((live != log[column]) & ((live != NEVER) | (log[column] < last_us)))
        ]
    return found

"""Statistics of a finished run: one definition of each, computed from the log of every message.

A time of transmission is the time at which a message's last byte crossed the link. The message reaches the server a
propagation delay later.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.sim.senders import Senders
from bufgym.sim.state import NEVER

NAN = float("nan")


@dataclass(frozen=True)
class Outcome:
    """The statistics of one finished run of one sender."""

    qoi: float
    """H = 1 + sum of V over the messages received; 0 if none was. With several topics, their weighted sum."""
    arrived: int
    """Messages that arrived at the sender."""
    delivered: int
    """Messages transmitted."""
    dropped: int
    """Messages evicted or rejected."""
    in_transmission: int
    """1 if the link stopped for good with a message on it; with n_T > 1 perhaps more."""
    buffered: int
    """Messages still queued at the end, for the same reason."""
    longest_gap: float
    """Largest step in the coordinate x between messages received one after the other."""
    longest_gap_s: float
    """Largest time between the arrivals of messages received one after the other, s."""
    mean_sojourn_s: float
    """Time from arrival at the sender to the end of transmission, mean over the messages delivered, s."""
    p95_sojourn_s: float
    """95th percentile of the sojourn time, s."""
    mean_age_s: float
    """Age of information at the server (now - arrival time of the newest received), mean over time from the first
    receipt to the last, s."""
    peak_age_s: float
    """Mean of the age just before each receipt that lowers it, s."""
    max_age_s: float
    """Largest age just before any receipt, s."""
    peak_backlog_bytes: int
    """Largest number of bytes queued; a message that goes straight to an idle socket counts as queued too."""
    invalid: int
    """Decisions that could not be carried out as given."""


def received(senders: Senders, i: int) -> NDArray[Any]:
    """MESSAGE[delivered]: messages that sender ``i`` transmitted, in that order."""
    batch = senders.batch
    order: NDArray[np.int64] = batch.order[i, : batch.senders[i]["transmitted"]]
    messages: NDArray[Any] = np.asarray(batch.arrivals[i])[order]
    return messages


def outcome(senders: Senders, i: int) -> Outcome:
    """The statistics of sender ``i``'s run."""
    batch = senders.batch
    sender = np.asarray(batch.senders)[i]
    messages = received(senders, i)
    log = np.asarray(batch.log[i])[: sender["arrivals"]]
    transmitted_us = log["transmitted_us"][messages["seq"]]
    ages = ages_s(transmitted_us + sender["propagation_us"], messages["arrival_us"])
    return Outcome(
        qoi=weighted_qoi(senders, i, messages) if senders.topics else senders.value_of(i).information(messages["x"]),
        arrived=int(sender["next"]),
        delivered=len(messages),
        dropped=int(sender["rejected"] + sender["evicted"]),
        in_transmission=int(sender["busy"]),
        buffered=int(sender["occupancy"]),
        longest_gap=float(np.diff(messages["x"]).max(initial=0)),
        longest_gap_s=float(np.diff(messages["arrival_us"]).max(initial=0)) / 1e6,
        **sojourns_s(transmitted_us - messages["arrival_us"]),
        **dict(zip(("mean_age_s", "peak_age_s", "max_age_s"), ages, strict=True)),
        peak_backlog_bytes=int(sender["peak_backlog_bytes"]),
        invalid=int(sender["invalid"]),
    )


@dataclass(frozen=True)
class TopicOutcome:
    """The statistics of one topic in one finished run."""

    topic: str
    """Its name."""
    qoi: float
    """Its own H, without its weight."""
    arrived: int
    """Messages that arrived at the sender."""
    delivered: int
    """Messages transmitted."""
    limited: int
    """Messages dropped because they came sooner than the rate limit allows."""
    lost: int
    """Messages dropped for other reasons."""
    buffered: int
    """Messages still queued or in the socket at the end."""
    bytes_delivered: int
    """Bytes of the messages transmitted."""
    mean_sojourn_s: float
    """Time from arrival at the sender to receipt at the server, propagation included, s; NaN if none was received."""
    p95_sojourn_s: float
    """95th percentile of the sojourn time, s."""
    mean_age_s: float
    """Age of information at the server, mean over time from the topic's first arrival to the episode's last, s."""
    peak_age_s: float
    """Largest age in that time, s."""
    late: int
    """Messages received after their deadline."""


def topic_outcomes(senders: Senders, i: int) -> list[TopicOutcome]:
    """The statistics of each topic of sender ``i``'s run, in the order of its topics."""
    sender = np.asarray(senders.batch.senders)[i]
    arrivals = np.asarray(senders.batch.arrivals[i])[: sender["arrivals"]]
    log = np.asarray(senders.batch.log[i])[: sender["arrivals"]]
    all_messages = received(senders, i)
    until_us = int(arrivals["arrival_us"][-1])
    outcomes = []
    for k, topic in enumerate(senders.topics):
        arrived = arrivals["topic"] == k
        messages = all_messages[all_messages["topic"] == k]
        dropped = arrived & (log["dropped_us"] != NEVER)
        limited = int((dropped & (log["limited"] == 1)).sum())
        received_us = log["transmitted_us"][messages["seq"]] + sender["propagation_us"]
        sojourn_us = received_us - messages["arrival_us"]
        first_us = int(arrivals["arrival_us"][arrived][0]) if arrived.any() else until_us
        outcomes.append(
            TopicOutcome(
                topic=topic.name,
                qoi=(topic.value or senders.value).information(messages["x"]),
                arrived=int(arrived.sum()),
                delivered=len(messages),
                limited=limited,
                lost=int(dropped.sum()) - limited,
                buffered=int(arrived.sum() - dropped.sum()) - len(messages),
                bytes_delivered=int(messages["size_bytes"].sum()),
                **sojourns_s(sojourn_us),
                **ages_between_s(received_us, messages["arrival_us"], first_us, until_us),
                late=int((sojourn_us / 1e6 > topic.deadline_s).sum()) if topic.deadline_s is not None else 0,
            )
        )
    return outcomes


def weighted_qoi(senders: Senders, i: int, messages: NDArray[Any]) -> float:
    """H of several topics: the sum of weight x H of each over ``messages``, MESSAGE[received]."""
    total = 0.0
    for k, topic in enumerate(senders.topics):
        total += topic.share * (topic.value or senders.value).information(messages["x"][messages["topic"] == k])
    return total


def sojourns_s(sojourn_us: NDArray[np.int64]) -> dict[str, float]:
    """Mean and 95th percentile of these sojourn times, s, by the names in an outcome; NaN if there are none."""
    sojourn_s = sojourn_us / 1e6 if len(sojourn_us) else np.array([NAN])
    return {"mean_sojourn_s": float(sojourn_s.mean()), "p95_sojourn_s": float(np.percentile(sojourn_s, 95))}


def ages_between_s(
    received_us: NDArray[np.int64], arrival_us: NDArray[np.int64], from_us: int, until_us: int
) -> dict[str, float]:
    """Mean and largest age of information from ``from_us`` to ``until_us``, s, by name; at the beginning it is 0.

    ``received_us`` must not decrease. NaN for a time of length 0.
    """
    if until_us <= from_us:
        return {"mean_age_s": NAN, "peak_age_s": NAN}
    known = received_us < until_us
    # Between two receipts the age grows by a second a second: each piece is a trapezium.
    begins_us = np.concatenate([[from_us], received_us[known]])
    ends_us = np.concatenate([received_us[known], [until_us]])
    newest_us = np.maximum.accumulate(np.concatenate([[from_us], arrival_us[known]]))
    low_us, high_us = begins_us - newest_us, ends_us - newest_us
    mean_us = ((low_us + high_us) / 2 * (ends_us - begins_us)).sum() / (until_us - from_us)
    return {"mean_age_s": float(mean_us) / 1e6, "peak_age_s": float(high_us.max()) / 1e6}


def ages_s(received_us: NDArray[np.int64], arrival_us: NDArray[np.int64]) -> tuple[float, float, float]:
    """Mean, mean peak and largest age of information, s (Kaul, Yates and Gruteser 2012); NaN below 2 receipts.

    Between two receipts the age grows with slope 1 from first receipt - newest arrival time so far: a trapezium.
    """
    if len(received_us) < 2:
        return NAN, NAN, NAN
    newest_us = np.maximum.accumulate(arrival_us)
    from_us, until_us = received_us[:-1] - newest_us[:-1], received_us[1:] - newest_us[:-1]
    lengths = np.diff(received_us)
    peaks = until_us[np.diff(newest_us) > 0]
    total = lengths.sum()
    mean = float(((from_us + until_us) / 2 * lengths).sum() / total) if total else float(from_us.mean())
    if len(peaks) == 0:
        peaks = until_us
    return mean / 1e6, float(peaks.mean()) / 1e6, float(until_us.max()) / 1e6

"""What a run was worth: one definition of each statistic, computed from what became of every message.

Times are those at which a message's last byte crossed the link; it reaches the server a propagation delay later.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.sender import NEVER, Senders


@dataclass(frozen=True)
class Outcome:
    """One finished run of one sender."""

    qoi: float
    """H = 1 + sum of V over the messages received; 0 if none was."""
    arrived: int
    delivered: int
    dropped: int
    in_transmission: int
    """1 where the link stopped for good with a message on it."""
    buffered: int
    """Still queued at the end, likewise."""
    longest_gap: float
    """Largest step in the coordinate x between messages received one after the other."""
    longest_gap_s: float
    """Largest time between the arrivals of messages received one after the other, s."""
    mean_sojourn_s: float
    """From arrival at the sender until the last byte has crossed, mean over the messages delivered, s."""
    p95_sojourn_s: float
    mean_age_s: float
    """Age of information at the server (now - arrival time of the newest received), mean over time from the first
    receipt to the last, s."""
    peak_age_s: float
    """The same just before each receipt that lowers it, mean over these, s."""
    max_age_s: float
    """The largest age just before any receipt, s."""
    peak_backlog_bytes: int
    """Bytes queued at most; one that goes straight to an idle socket passes through the queue as well."""
    impossible: int
    """Decisions that could not be carried out as given."""


METRICS = tuple(f.name for f in fields(Outcome))


def received(senders: Senders, i: int) -> NDArray[Any]:
    """MESSAGE[delivered]: what the link carried, in the order in which it did."""
    batch = senders.batch
    order: NDArray[np.int64] = batch.order[i, : batch.senders[i]["crossed"]]
    messages: NDArray[Any] = np.asarray(batch.arrivals[i])[order]
    return messages


def outcome(senders: Senders, i: int) -> Outcome:
    """The statistics of sender ``i``'s run."""
    batch = senders.batch
    sender = np.asarray(batch.senders)[i]
    got = received(senders, i)
    fates = np.asarray(batch.fates[i])[: sender["arrivals"]]
    crossed_us = fates["crossed_us"][got["seq"]]
    sojourn_s = (crossed_us - got["arrival_us"]) / 1e6
    mean_age, peak_age, max_age = ages_s(crossed_us + sender["propagation_us"], got["arrival_us"])
    none = float("nan")
    return Outcome(
        qoi=senders.value.information(got["x"]),
        arrived=int(sender["next"]),
        delivered=len(got),
        dropped=int((fates["dropped_us"] != NEVER).sum()),
        in_transmission=int(sender["busy"]),
        buffered=int(sender["occupancy"]),
        longest_gap=float(np.diff(got["x"]).max(initial=0)),
        longest_gap_s=float(np.diff(got["arrival_us"]).max(initial=0)) / 1e6,
        mean_sojourn_s=float(sojourn_s.mean()) if len(got) else none,
        p95_sojourn_s=float(np.percentile(sojourn_s, 95)) if len(got) else none,
        mean_age_s=mean_age,
        peak_age_s=peak_age,
        max_age_s=max_age,
        peak_backlog_bytes=int(sender["peak_backlog_bytes"]),
        impossible=int(sender["impossible"]),
    )


def ages_s(received_us: NDArray[np.int64], arrival_us: NDArray[np.int64]) -> tuple[float, float, float]:
    """(mean, mean peak, largest) age of information, s (Kaul, Yates and Gruteser 2012); NaN with fewer than 2 receipts.

    Between two receipts the age grows from (first receipt - newest arrival time so far) at slope 1: a trapezium.
    """
    if len(received_us) < 2:
        return (float("nan"),) * 3
    newest_us = np.maximum.accumulate(arrival_us)
    from_us, until_us = received_us[:-1] - newest_us[:-1], received_us[1:] - newest_us[:-1]
    lengths = np.diff(received_us)
    peaks = until_us[np.diff(newest_us) > 0]
    total = lengths.sum()
    mean = float(((from_us + until_us) / 2 * lengths).sum() / total) if total else float(from_us.mean())
    if len(peaks) == 0:
        peaks = until_us
    return mean / 1e6, float(peaks.mean()) / 1e6, float(until_us.max()) / 1e6

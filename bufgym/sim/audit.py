"""A check after a run that a policy did not change the records of its sender.

Compiled policies see the sender's own records, which spares a copy at every decision, but Numba lets them write there.
So every benchmark run is checked at its end: a policy that changed a message or a topic's rules has no result.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.model.qoi import information
from bufgym.scenario import Episode
from bufgym.sim.state import NEVER, Batch

ARRIVAL = "a message that arrived is not as the episode has it"
QUEUED = "a queued message is not as it arrived"
BYTES = "the queue's bytes are not those of its messages"
LOG = "not every message was sent, dropped or queued exactly once"
TOPIC = "a topic's rules are not as they were"
QOI = "H is not that of the messages that were received"

_MESSAGE = ("seq", "arrival_us", "size_bytes", "topic", "x", "uniform")
_RULES = ("priority", "weight", "period_us", "limit", "no_drop", "deadline_us", "v_start")
_ROUNDING = 1e-9
"""Tolerance: H is added up in another order here."""


def touched(batch: Batch, i: int, episode: Episode, topic_table: NDArray[Any]) -> str:
    """What does not agree with the episode or the topics' rules in sender ``i``'s finished run; empty if all does."""
    sender, arrivals = np.asarray(batch.senders)[i], np.asarray(episode.arrivals)
    log = np.asarray(batch.log[i])[: len(arrivals)]
    if not _same(batch.arrivals[i, : len(arrivals)], arrivals, _MESSAGE):
        return ARRIVAL
    dequeued, dropped = log["dequeued_us"] != NEVER, log["dropped_us"] != NEVER
    if (dequeued & (dropped | (log["dequeued_us"] < arrivals["arrival_us"]))).any():
        return LOG
    queued = np.asarray(batch.slots[i])[sender["first"] : sender["first"] + sender["occupancy"]]
    seq = queued["seq"]
    if not ((np.diff(seq, prepend=-1) > 0) & (seq < len(arrivals))).all():
        return QUEUED
    if not _same(queued, arrivals[seq], _MESSAGE) or (dequeued | dropped)[seq].any():
        return QUEUED
    if queued["size_bytes"].sum() != sender["backlog_bytes"]:
        return BYTES
    # Each event writes one entry: as many entries as events means that no two were about one message.
    sent, gone = dequeued.sum(), dropped.sum()
    counted = sent == sender["dequeued"] and gone == sender["evicted"] + sender["rejected"]
    if not counted or sent + gone + len(queued) != sender["next"]:
        return LOG
    if not _same(batch.topics[i], topic_table, _RULES):
        return TOPIC
    gained = _gained(batch, i, arrivals[batch.order[i, : sender["credited"]]])
    return QOI if abs(gained - sender["delivered_gain"]) > _ROUNDING * max(1.0, gained) else ""


def _gained(batch: Batch, i: int, messages: NDArray[Any]) -> float:
    """Gain of sender ``i`` from the received ``messages``, without the 1 of each topic."""
    sender, topics, x = np.asarray(batch.senders)[i], np.asarray(batch.topics[i]), messages["x"]
    parts = [(1.0, sender["v_start"], x)]
    if len(topics) > 1:
        parts = [(row["weight"], row["v_start"], x[messages["topic"] == k]) for k, row in enumerate(topics)]
    return sum(w * max(0.0, information(batch.v[start:], np.ascontiguousarray(x)) - 1) for w, start, x in parts)


def _same(a: NDArray[Any], b: NDArray[Any], fields: tuple[str, ...]) -> bool:
    """Whether the records are equal in these fields."""
    return all(np.array_equal(a[field], b[field]) for field in fields)

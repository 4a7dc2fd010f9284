"""Observation fields and reward terms, one table each, from which spaces, code and docs are made.

Every field is computed from the ``Buffer`` view and the arrival alone, that is from a robot's own buffer, clock,
odometry and socket. Nothing comes from the server or the link's future.

Every field lies in [0, 1] and is free of scale. Lengths g (of time, motion, bytes) appear as g / (g + r) with a stated
reference r, so 0.5 means "as long as the reference". For gaps r is the *even spacing*: the distance from the message
dequeued last to the newcomer, divided by L + 1. That is the gap between neighbours if L messages thin this stretch
evenly (AFR's aim). So one set of weights serves every L and frame rate.

With several topics a message's neighbours belong to its own topic. The even spacing is the distance from the topic's
message dequeued last to its last arrival, divided by one more than its queued messages. Values are weighted: QoI is in
units of the largest weight. Further fields describe the topics.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Field:
    """One observed quantity."""

    name: str
    """Unique over all tables."""
    per: str
    """"slot" for L + 1 entries, the newcomer's last; "context" for one."""
    group: str
    """Knowledge that it needs: queue (counting), time (a clock), motion (odometry), value (V), link (its own socket) or
    topic (the topics' settings and past)."""
    unit: str
    """Its unit, or how it is scaled to [0, 1]."""
    meaning: str
    """Meaning in words."""
    low: float = 0.0
    """Least value."""
    high: float = 1.0
    """Largest value."""


SLOT_FIELDS = (
    Field("occupied", "slot", "queue", "flag", "1 where the slot holds a message (the newcomer's always does)"),
    Field("rank", "slot", "queue", "fraction", "(k + 1) / (s + 1) for slot k of s queued; 1 for the newcomer"),
    Field("time_before", "slot", "time", "g/(g+r), r = even time spacing", "time since the message kept before it"),
    Field("time_merged", "slot", "time", "g/(g+r), r = 2 x even time spacing", "time gap left if it is dropped"),
    Field("motion_before", "slot", "motion", "g/(g+r), r = even motion spacing", "motion since the message before it"),
    Field(
        "motion_merged", "slot", "motion", "g/(g+r), r = 2 x even motion spacing", "motion gap left if it is dropped"
    ),
    Field("loss", "slot", "value", "QoI", "V(a) + V(b) - V(a+b): QoI lost if it alone is dropped now"),
    Field("size", "slot", "queue", "g/(g+r), r = mean queued size", "its bytes"),
    Field("relative_loss", "slot", "value", "l/(l+r), r = that of an even gap", "the same loss, free of V's scale"),
)
CONTEXT_FIELDS = (
    Field("occupancy", "context", "queue", "fraction of L", "messages queued"),
    Field("backlog", "context", "queue", "fraction of B", "bytes queued; 0 where there is no byte limit"),
    Field("arrival_time_gap", "context", "time", "g/(g+r), r = even time spacing", "time since the previous arrival"),
    Field("arrival_motion_gap", "context", "motion", "g/(g+r), r = even motion spacing", "motion since then"),
    Field("busy", "context", "link", "flag", "1 while a message is in transmission"),
    Field("left", "context", "link", "fraction", "part of the message in transmission that is still to be transmitted"),
    Field("stalled", "context", "link", "g/(g+r), r = L + 1 arrival periods", "time since a message was last dequeued"),
    Field("departures", "context", "link", "n/(n+1)", "messages dequeued since the previous arrival"),
    Field("service_ratio", "context", "link", "g/(g+r), r = 1", "running mean of departures per arrival"),
    Field("even_value", "context", "value", "QoI", "V of the even motion spacing e"),
    Field("bend", "context", "value", "fraction", "(2 V(e) - V(2e)) / V(e): 0 where V is straight, 1 where it is flat"),
)
FIELDS = SLOT_FIELDS + CONTEXT_FIELDS

TOPIC_SLOT_FIELDS = (
    Field("priority", "slot", "topic", "fraction of the highest", "priority of its topic"),
    Field("weight", "slot", "topic", "fraction of the largest", "weight of its topic in the sum of H"),
    Field("no_drop", "slot", "topic", "flag", "1 where it may not be dropped"),
    Field("oldest", "slot", "topic", "flag", "1 where it is the oldest of its topic, the only one that may be sent"),
    Field("own", "slot", "topic", "flag", "1 where its topic is the newcomer's; 0 when the socket asks"),
    Field("waited", "slot", "topic", "g/(g+r), r = 1 s", "time since its arrival"),
    Field(
        "silence", "slot", "topic", "g/(g+r), r = 1 s", "time since the arrival of its topic's message dequeued last"
    ),
    Field("lateness", "slot", "topic", "g/(g+r), r = its deadline", "time since its arrival; 0 without a deadline"),
    Field("queued", "slot", "topic", "fraction of L", "messages of its topic in the buffer"),
    Field("gain", "slot", "topic", "QoI, weighted", "what its delivery adds to H"),
    Field("gain_per_byte", "slot", "topic", "g/(g+r), r = mean of the queue", "the same for each byte of it"),
)
TOPIC_CONTEXT_FIELDS = (
    Field("socket_asks", "context", "topic", "flag", "1 where the socket asks what to send, 0 at an arrival"),
    Field("in_flight", "context", "topic", "n/(n+r), r = n_T", "messages sent and not yet acknowledged"),
)
TOPIC_FIELDS = TOPIC_SLOT_FIELDS + TOPIC_CONTEXT_FIELDS
"""Fields observed besides ``FIELDS`` with several topics."""

# Where each field stands in the observation of its kind, with one queue and with topics: constants for kernels.
OCCUPIED, RANK, TIME_BEFORE, TIME_MERGED, MOTION_BEFORE, MOTION_MERGED, LOSS, SIZE, RELATIVE_LOSS = range(9)
PRIORITY, WEIGHT, NO_DROP, OLDEST, OWN, WAITED, SILENCE, LATENESS, QUEUED, GAIN, GAIN_PER_BYTE = range(9, 20)
OCCUPANCY, BACKLOG, ARRIVAL_TIME_GAP, ARRIVAL_MOTION_GAP, BUSY, LEFT, STALLED, DEPARTURES = range(8)
SERVICE_RATIO, EVEN_VALUE, BEND, SOCKET_ASKS, IN_FLIGHT = range(8, 13)


@dataclass(frozen=True)
class RewardTerm:
    """A named reward; an environment rewards a weighted sum of them and reports each by name in ``info``."""

    name: str
    """Unique over all terms."""
    unit: str
    """Its unit."""
    meaning: str
    """Meaning in words."""


REWARD_TERMS = (
    RewardTerm("delivered", "QoI", "V gained when a message arrives at the server; sums to H - 1"),
    RewardTerm("retained", "QoI", "change of the H that delivering all that is kept would give; sums to H - 1 too"),
)
"""``retained`` is ``delivered`` shaped by a potential, the QoI held and not yet delivered (Ng, Harada and Russell
1999). It shows at once what a decision costs or gains, and telescopes to the same total."""
TOPIC_REWARD_TERMS = (
    RewardTerm("age", "s^2", "minus the weighted mean age of information at the server, integrated over time"),
    RewardTerm("late", "messages", "minus the weight of each message that reaches the server after its deadline"),
)
"""Further terms with several topics; weights are fractions of their sum over the topics."""

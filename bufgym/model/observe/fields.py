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

from dataclasses import dataclass

from bufgym.model.observe.queue import CONTEXT_FIELDS, SLOT_FIELDS
from bufgym.model.observe.topics import TOPIC_CONTEXT_FIELDS, TOPIC_SLOT_FIELDS

FIELDS = SLOT_FIELDS + CONTEXT_FIELDS
TOPIC_FIELDS = TOPIC_SLOT_FIELDS + TOPIC_CONTEXT_FIELDS
"""Fields observed besides ``FIELDS`` with several topics."""


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

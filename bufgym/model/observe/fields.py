"""Observation fields and reward terms, one table each, from which spaces, code and docs are made.

See docs/methods.md, "What observation fields mean".
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

"""What an agent observes and is rewarded for: tables of fields, and the kernels that fill them from a robot's view."""

from bufgym.observe.fields import (
    CONTEXT_FIELDS,
    FIELDS,
    REWARD_TERMS,
    SLOT_FIELDS,
    TOPIC_CONTEXT_FIELDS,
    TOPIC_FIELDS,
    TOPIC_REWARD_TERMS,
    TOPIC_SLOT_FIELDS,
    Field,
    RewardTerm,
)
from bufgym.observe.queue import observe_context, observe_slots
from bufgym.observe.topics import observe_topic_context, observe_topic_slots

__all__ = [
    "CONTEXT_FIELDS",
    "FIELDS",
    "REWARD_TERMS",
    "SLOT_FIELDS",
    "TOPIC_CONTEXT_FIELDS",
    "TOPIC_FIELDS",
    "TOPIC_REWARD_TERMS",
    "TOPIC_SLOT_FIELDS",
    "Field",
    "RewardTerm",
    "observe_context",
    "observe_slots",
    "observe_topic_context",
    "observe_topic_slots",
]

"""Observations and rewards of an agent: tables of fields, and the kernels that fill them from a robot's view.

``@field`` and ``@reward_term`` add your own.
"""

from bufgym.model.observe.candidates import (
    CANDIDATE_FIELDS,
    QUEUE_FIELDS,
    decision_of_candidate,
    find_candidates,
    is_offered,
    observe_candidates,
)
from bufgym.model.observe.chosen import BUILT_IN, Chosen, chosen_at, write_chosen, write_chosen_on_board
from bufgym.model.observe.declare import Field
from bufgym.model.observe.on_board import (
    ON_BOARD_FIELDS,
    ON_BOARD_SLOT_FIELDS,
    observe_on_board,
    observe_on_board_slots,
)
from bufgym.model.observe.own import (
    OWN_FIELDS,
    OWN_TERMS,
    REWARD_TERMS,
    OwnTerm,
    RewardTerm,
    field,
    own_field,
    own_term,
    reward_term,
)
from bufgym.model.observe.past import PAST_FIELDS
from bufgym.model.observe.queue import CONTEXT_FIELDS, SLOT_FIELDS, observe
from bufgym.model.observe.terms import TOPIC_REWARD_TERMS, terms_for
from bufgym.model.observe.topics import (
    FIELDS,
    TOPIC_CONTEXT_FIELDS,
    TOPIC_FIELDS,
    TOPIC_SLOT_FIELDS,
    observe_topic_context,
    observe_topic_slots,
)

__all__ = ["field", "reward_term"]

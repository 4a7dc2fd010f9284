"""Fields that know what the rule gap-price knows: an agent that scores slots may begin at the rule and learn the rest.

Slot fields compare each candidate with the target gap g of ``target_gap`` and with the price of ``price_dp``. Context
fields are ``guided.INPUTS`` and the state of the socket. All need the rule's memory, so an environment observes either
these or its own (``fields="rule"``).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space, motion_gaps
from bufgym.model.observe import Field
from bufgym.model.observe.declare import TINY, writer
from bufgym.model.observe.on_board import mean_bytes, time_to_free
from bufgym.model.qoi import merging_loss, value
from bufgym.policies import chains, price_dp, target_gap
from bufgym.policies.gaps import discounted
from bufgym.policies.guided import BASE, INPUT_FIELDS, MOST, N_INPUTS, RULE, bounded, inputs, lg, recall
from bufgym.policies.registry import Arrival, Memory
from bufgym.policies.target_gap import free_soon, target


class Candidate(NamedTuple):
    """A queued message or the newcomer, as the rule sees it."""

    place: float  # (k + 1) / (s + 1) for slot k of s
    is_newcomer: bool
    before: float  # motion gap to the message kept before it
    after: float  # motion gap to the message after it
    left: float  # discounted gap left if it is dropped
    g: float  # the target gap
    advantage: float  # price-dp's advantage of dropping it, in price-dp's unit
    lost: float  # V lost if it is dropped
    unit: float  # price-dp's unit of V
    has_turn: bool  # whether it is a head whose turn is near
    drops: bool  # whether the rule drops it


_RATIO = "logarithm of a ratio"
RULE_SLOT_FIELDS = (
    Field("rule_place", "slot", "link", "share", "(k + 1) / (s + 1) for slot k of s", lambda slot: slot.place),
    Field("rule_newcomer", "slot", "link", "0 or 1", "1 for the newcomer",
          lambda slot: 1.0 if slot.is_newcomer else 0.0),
    Field("rule_merged", "slot", "link", _RATIO, "lg(gap left if it is dropped, 2 g)",
          lambda slot: lg(slot.before + slot.after, 2 * slot.g), -MOST, MOST),
    Field("rule_before", "slot", "link", _RATIO, "lg(gap before it, g)",
          lambda slot: lg(slot.before, slot.g), -MOST, MOST),
    Field("rule_after", "slot", "link", _RATIO, "lg(gap after it, g)",
          lambda slot: lg(slot.after, slot.g), -MOST, MOST),
    Field("rule_preference", "slot", "link", "g",
          "target-gap's preference for dropping it: 1 - the discounted gap left / g",
          lambda slot: bounded(BASE[price_dp.THRESHOLD] - slot.left / slot.g), -MOST, MOST),
    Field("rule_advantage", "slot", "link", "price-dp's unit", "price-dp's advantage of dropping it",
          lambda slot: bounded(slot.advantage), -MOST, MOST),
    Field("rule_loss", "slot", "link", _RATIO, "lg(V lost if it is dropped, price-dp's unit)",
          lambda slot: lg(max(slot.lost, 0.0), slot.unit), -MOST, MOST),
    Field("rule_head", "slot", "link", "g",
          "how much nearer to g the gap after dropping it is; 0 but for a head whose turn is near",
          lambda slot: bounded((abs(slot.before - slot.g) - abs(slot.before + slot.after - slot.g)) / slot.g)
          if slot.has_turn else 0.0, -MOST, MOST),
    Field("rule_drops", "slot", "link", "0 or 1", "1 if the rule drops it", lambda slot: 1.0 if slot.drops else 0.0),
)  # fmt: skip
"""In the order in which ``observe_rule`` writes them."""
_STATE_FIELDS = (
    Field("rule_soon", "context", "link", "0 or 1",
          "1 if the socket is free before so many arrivals that target-gap asks the head",
          lambda buffer, arrival, soon, accepts: 1.0 if soon else 0.0),
    Field("rule_to_free", "context", "link", "share",
          "time until the socket is free beside the arrival period, as ``time_to_free``",
          lambda buffer, arrival, soon, accepts: time_to_free(buffer, arrival)),
    Field("rule_room", "context", "link", "0 or 1", "1 if there is room for the newcomer",
          lambda buffer, arrival, soon, accepts: 1.0 if has_space(buffer, arrival) else 0.0),
    Field("rule_idle", "context", "link", "0 or 1", "1 if the socket is idle",
          lambda buffer, arrival, soon, accepts: 0.0 if buffer.busy else 1.0),
    Field("rule_accepts", "context", "link", "0 or 1", "1 if the rule accepts the newcomer",
          lambda buffer, arrival, soon, accepts: 1.0 if accepts else 0.0),
)  # fmt: skip
RULE_FIELDS = (*(replace(field, name=f"guided_{field.name}") for field in INPUT_FIELDS), *_STATE_FIELDS)
"""The context's, in that order too."""
_write_slot = writer(RULE_SLOT_FIELDS, "slot")
_write_state = writer(_STATE_FIELDS, "buffer, arrival, soon, accepts", first=N_INPUTS)


@kernel
def observe_rule(
    buffer: Buffer, arrival: Arrival, memory: Memory, rows: NDArray[Any], context: NDArray[np.floating[Any]]
) -> None:
    """Update the rule's memory, then write the fields: ``rows`` [slot fields, L + 1], the newcomer's last."""
    recall(buffer, arrival, memory, BASE)
    inputs(buffer, arrival, memory, BASE, context)
    rule, s, last = memory[RULE:], len(buffer.slots), buffer.capacity
    g = target(buffer, arrival, rule, BASE)
    if g <= 0:
        g = (arrival.x - buffer.dequeued_x) / (s + 1)
    g = max(g, TINY)
    soon = s > 0 and free_soon(buffer, BASE[target_gap.NEAR])
    a = price_dp.share(rule, BASE)
    if a > 0:
        chosen = price_dp.decide(buffer, arrival, rule, BASE, a)
    else:
        chosen = target_gap.decide(buffer, arrival, rule, BASE)
    _write_state(buffer, arrival, soon, chosen == ACCEPT, context)
    even = value(buffer.v, g)
    unit = max(BASE[price_dp.KAPPA] * merging_loss(buffer.v, g, even, g, even), TINY)
    scratch = rule[price_dp.ENTRIES :]
    chains.weigh(buffer, arrival, unit / mean_bytes(buffer, arrival), arrival.x + BASE[price_dp.TAIL] * g, scratch)
    rows[:, s:last] = 0.0
    for k in range(s + 1):
        before, after = motion_gaps(buffer, arrival, k)
        before, after = max(before, 0.0), max(after, 0.0)
        slot = Candidate(
            place=(k + 1) / (s + 1),
            is_newcomer=k == s,
            before=before,
            after=after,
            left=discounted(buffer, arrival, False, k, BASE[target_gap.DISCOUNT]),
            g=g,
            advantage=chains.advantage(scratch, k) / unit,
            lost=merging_loss(buffer.v, before, value(buffer.v, before), after, value(buffer.v, after)),
            unit=unit,
            has_turn=k == 0 and soon,
            drops=chosen == k or (chosen == REJECT and k == s),
        )
        _write_slot(slot, k if k < s else last, rows)

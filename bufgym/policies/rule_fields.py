"""Fields that know what the rule gap-price knows: an agent that scores slots may begin at the rule and learn the rest.

Slot fields compare each candidate with the target gap g of ``target_gap`` and with the price of ``price_dp``. Context
fields are ``guided.INPUTS`` and the state of the socket. All need the rule's memory, so they belong to policies and are
no fields of an environment's observation.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space, motion_gaps
from bufgym.model.observe import Field
from bufgym.model.observe.declare import TINY
from bufgym.model.observe.on_board import mean_bytes, time_to_free
from bufgym.model.qoi import merging_loss, value
from bufgym.policies import chains, price_dp, target_gap
from bufgym.policies.gaps import discounted
from bufgym.policies.guided import BASE, INPUTS, MOST, N_INPUTS, RULE, bounded, inputs, lg, recall
from bufgym.policies.registry import Arrival, Memory
from bufgym.policies.target_gap import free_soon, target

_RATIO = "logarithm of a ratio"
RULE_SLOT_FIELDS = tuple(
    Field(name, "slot", "link", unit, meaning, low, high)
    for name, unit, meaning, low, high in (
        ("rule_place", "share", "(k + 1) / (s + 1) for slot k of s", 0.0, 1.0),
        ("rule_newcomer", "0 or 1", "1 for the newcomer", 0.0, 1.0),
        ("rule_merged", _RATIO, "lg(gap left if it is dropped, 2 g)", -MOST, MOST),
        ("rule_before", _RATIO, "lg(gap before it, g)", -MOST, MOST),
        ("rule_after", _RATIO, "lg(gap after it, g)", -MOST, MOST),
        ("rule_preference", "g", "target-gap's preference for dropping it: 1 - discounted gap left / g", -MOST, MOST),
        ("rule_advantage", "price-dp's unit", "price-dp's advantage of dropping it", -MOST, MOST),
        ("rule_loss", _RATIO, "lg(V lost if it is dropped, price-dp's unit)", -MOST, MOST),
        ("rule_head", "g", "how much nearer to g the gap after dropping it is; 0 but for a head whose turn is near",
         -MOST, MOST),
        ("rule_drops", "0 or 1", "1 if the rule drops it", 0.0, 1.0),
    )
)  # fmt: skip
"""In the order in which ``observe_rule`` writes them."""
RULE_FIELDS = tuple(
    Field(f"guided_{name}", "context", "link", "see its meaning", meaning, -4.0, 4.0)
    for name, meaning in INPUTS.items()
) + tuple(
    Field(name, "context", "link", "share" if name == "rule_to_free" else "0 or 1", meaning)
    for name, meaning in (
        ("rule_soon", "1 if the socket is free before so many arrivals that target-gap asks the head"),
        ("rule_to_free", "time until the socket is free beside the arrival period, as ``time_to_free``"),
        ("rule_room", "1 if there is room for the newcomer"),
        ("rule_idle", "1 if the socket is idle"),
        ("rule_accepts", "1 if the rule accepts the newcomer"),
    )
)
"""The context's, in that order too."""


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
    context[N_INPUTS] = 1.0 if soon else 0.0
    context[N_INPUTS + 1] = time_to_free(buffer, arrival)
    context[N_INPUTS + 2] = 1.0 if has_space(buffer, arrival) else 0.0
    context[N_INPUTS + 3] = 0.0 if buffer.busy else 1.0
    a = price_dp.share(rule, BASE)
    if a > 0:
        chosen = price_dp.decide(buffer, arrival, rule, BASE, a)
    else:
        chosen = target_gap.decide(buffer, arrival, rule, BASE)
    context[N_INPUTS + 4] = 1.0 if chosen == ACCEPT else 0.0
    even = value(buffer.v, g)
    unit = max(BASE[price_dp.KAPPA] * merging_loss(buffer.v, g, even, g, even), TINY)
    scratch = rule[price_dp.ENTRIES :]
    chains.weigh(buffer, arrival, unit / mean_bytes(buffer, arrival), arrival.x + BASE[price_dp.TAIL] * g, scratch)
    rows[:, s:last] = 0.0
    for k in range(s + 1):
        at = k if k < s else last
        before, after = motion_gaps(buffer, arrival, k)
        before, after = max(before, 0.0), max(after, 0.0)
        left = discounted(buffer, arrival, False, k, BASE[target_gap.DISCOUNT])
        lost = merging_loss(buffer.v, before, value(buffer.v, before), after, value(buffer.v, after))
        rows[0, at] = (k + 1) / (s + 1)
        rows[1, at] = 1.0 if k == s else 0.0
        rows[2, at] = lg(before + after, 2 * g)
        rows[3, at] = lg(before, g)
        rows[4, at] = lg(after, g)
        rows[5, at] = bounded(BASE[price_dp.THRESHOLD] - left / g)
        rows[6, at] = bounded(chains.advantage(scratch, k) / unit)
        rows[7, at] = lg(max(lost, 0.0), unit)
        turn = k == 0 and soon
        rows[8, at] = bounded((abs(before - g) - abs(before + after - g)) / g) if turn else 0.0
        rows[9, at] = 1.0 if chosen == k or (chosen == REJECT and k == s) else 0.0

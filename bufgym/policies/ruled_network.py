"""Learned policies among ordered candidates and what the rule ``gap-price`` would do: one network for every link.

At every arrival the policy looks at the k cheapest candidates and the head, as ``candidate_network`` does, at what the
rule knows (``rule_inputs.INPUTS``), at the past of link and camera (``past_inputs.PAST_INPUTS``), and at the rule's own
decision. Its network has an output for each action:

    0: accept where there is room, else drop the cheapest;  1 to k + 1: candidates;  k + 2: what the rule does

and the highest output of those that are offered decides. The rule alone is offered until a rate has been
measured, on a steady link whose rate has not changed by over 10 % for ``EVEN_US``, and where hindsight teaches nothing
(``left_to_rule``). See docs/methods.md, "Networks among candidates".
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import Buffer, has_space
from bufgym.model.observe import (
    CANDIDATE_FIELDS,
    QUEUE_FIELDS,
    decision_of_candidate,
    find_candidates,
    is_offered,
    observe_candidates,
)
from bufgym.model.past import CHANGED_US
from bufgym.model.qoi import EXPONENTIAL
from bufgym.policies import chains, price_dp, target_gap
from bufgym.policies.candidate_network import CANDIDATES, HIDDEN, WIDTHS, CandidateWeights, Singles, forward, singles
from bufgym.policies.past_inputs import N_PAST, NOTHING, PAST_INPUTS, PAST_NAMES, past_inputs
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.policies.rule_inputs import BASE, INPUT_FIELDS, MEANINGS, N_INPUTS, REMEMBERED, RULE, inputs, recall
from bufgym.policies.target_gap import bursty
from bufgym.policies.thinning import steady

NOT_OFFERED = -100
"""In place of the decision of an action that is not offered."""
OF_RULE = tuple(f"rule_{field.name}" for field in INPUT_FIELDS)
EVEN_US = 3e6
"""How long a link must not have changed to be even, us."""
STATE = ("room", "log_capacity")
"""1 if there is room for the newcomer; log(L / 8)."""
PER_CANDIDATE, QUEUE, N_STATE = len(CANDIDATE_FIELDS), len(QUEUE_FIELDS), len(STATE)


@kernel
def seen(candidates: int) -> int:
    """The count of numbers seen: of candidates, the rule, ``STATE``, the past, whether each action is the rule's."""
    return PER_CANDIDATE * (candidates + 1) + QUEUE + N_INPUTS + N_STATE + N_PAST + candidates + 2


def fields_seen(candidates: int) -> list[str]:
    """The name of each number that is seen, in order."""
    of_candidates = [field.name for field in CANDIDATE_FIELDS for _ in range(candidates + 1)]
    same = [f"rule_takes_{a}" for a in range(candidates + 2)]
    return [*of_candidates, *(field.name for field in QUEUE_FIELDS), *OF_RULE, *STATE, *PAST_NAMES, *same]


@kernel
def rule_decision(buffer: Buffer, arrival: Arrival, rule: Memory) -> int:
    """What gap-price does, once its memory is up to date."""
    a = price_dp.share(rule, BASE)
    if a > 0:
        return price_dp.decide(buffer, arrival, rule, BASE, a)
    return target_gap.decide(buffer, arrival, rule, BASE)


@kernel
def even(buffer: Buffer) -> bool:
    """Whether the link has carried at one rate for ``EVEN_US``, or no rate has been measured yet.

    Regret is so small there that a network which wavers once loses several times what the rule loses.
    """
    changed_us = buffer.past[CHANGED_US]
    return bool(changed_us == 0 or (buffer.now_us - changed_us > EVEN_US and steady(buffer)))


@kernel
def left_to_rule(buffer: Buffer, memory: Memory) -> bool:
    """Whether the rule alone decides: what hindsight says there teaches nothing, or the network was not taught it.

    On an even link, in bursts, where V saturates and where sizes differ, accepting is free in hindsight, as the
    clairvoyant could still drop the right messages later; who accepts does not. A V by a table was never met.
    """
    rule, is_other = memory[RULE:], buffer.v[0] != EXPONENTIAL
    is_unequal = price_dp.share(rule, BASE) > 0
    return bool(is_other or is_unequal or bursty(rule) or even(buffer))


@kernel
def look(buffer: Buffer, arrival: Arrival, memory: Memory, own: Memory, numbers: Singles, places: int) -> None:
    """Write what is seen into ``numbers``.

    Order and cost of the ``places`` = k + 1 candidates and each action's decision go into ``own``. ``memory`` begins
    with the rule's, which is updated.
    """
    actions = places + 2
    order, cost, decisions = own[:places], own[places : 2 * places], own[2 * places : 2 * places + actions]
    of_candidates = PER_CANDIDATE * places + QUEUE
    room = has_space(buffer, arrival)
    recall(buffer, arrival, memory, BASE)
    find_candidates(buffer, arrival, order, cost)
    observe_candidates(buffer, arrival, order, cost, numbers[:of_candidates])
    inputs(buffer, arrival, memory, BASE, numbers[of_candidates : of_candidates + N_INPUTS])
    by_rule = rule_decision(buffer, arrival, memory[RULE:])
    at = of_candidates + N_INPUTS
    numbers[at], numbers[at + 1] = 1.0 if room else 0.0, math.log(buffer.capacity / 8)
    at += N_STATE
    past_inputs(buffer, arrival, numbers[at : at + N_PAST])
    at += N_PAST
    decisions[actions - 1] = by_rule
    alone = left_to_rule(buffer, memory)
    for a in range(actions - 1):
        decisions[a], numbers[at + a] = NOT_OFFERED, 0.0
        if not alone and is_offered(order, True, room, a):
            decisions[a] = decision_of_candidate(order, len(buffer.slots), True, room, a)
            numbers[at + a] = 1.0 if decisions[a] == by_rule else 0.0


def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A trained network that chooses among ordered candidates and what gap-price would do."""
    own = memory[len(memory) - own_numbers(buffer.parameters) :]
    places = int(buffer.parameters[CANDIDATES]) + 1
    parameters, actions = buffer.parameters, places + 2
    decisions, units = own[2 * places : 2 * places + actions], own[2 * places + actions :].view(np.float32)
    look(buffer, arrival, memory, own, units, places)
    outputs = units[forward(parameters, units, seen(places - 1)) :]
    best, decision = -np.inf, 0
    for a in range(actions):
        if decisions[a] != NOT_OFFERED and outputs[a] > best:
            best, decision = outputs[a], int(decisions[a])
    return decision


@kernel
def own_numbers(parameters: NDArray[np.float64]) -> int:
    """How much of the memory's end the network takes."""
    places = int(parameters[CANDIDATES]) + 1
    units = widest = seen(places - 1)
    for layer in range(int(parameters[HIDDEN]) + 1):
        units += int(parameters[WIDTHS + layer])
        if layer < int(parameters[HIDDEN]):
            widest = max(widest, int(parameters[WIDTHS + layer]))
    return 3 * places + 2 + singles(units + widest)


def watch_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """What gap-price does; the memory ends with each action's decision and what the network would see."""
    places = int(buffer.parameters[CANDIDATES]) + 1
    own = memory[len(memory) - (3 * places + 2 + singles(seen(places - 1))) :]
    look(buffer, arrival, memory, own, own[3 * places + 2 :].view(np.float32), places)
    return int(own[3 * places + 1])


def watcher(candidates: int) -> Policy:
    """The rule gap-price, which leaves in its memory what a network with so many candidates would see.

    ``watched`` reads it.
    """
    places = candidates + 1
    work = chains.SCRATCH[0] + 3 * places + 2 + singles(seen(candidates)), chains.SCRATCH[1]
    return Policy(
        "watcher", watch_arrival, weights=(float(candidates), 1.0, 1.0, 0.0, 0.0), memory=REMEMBERED, work=work,
        compile=True, built_in=True, reads_rate=True, reads_left=True, reads_past=True,
    )  # fmt: skip


def watched(memory: Memory, candidates: int) -> tuple[NDArray[np.float64], Singles]:
    """(Decisions of all actions, float64[..., k + 3]; what is seen, float32[..., seen(k)]) of the watcher."""
    numbers = memory.shape[-1] - singles(seen(candidates))
    decisions = memory[..., numbers - (candidates + 3) : numbers]
    return decisions, memory[..., numbers:].view(np.float32)[..., : seen(candidates)]


@dataclass(frozen=True)
class RuledWeights(CandidateWeights):
    """A network among ordered candidates and gap-price's decision that sees the past, as in a file."""

    CONTEXT_NAMES: ClassVar[tuple[str, ...]] = (*CandidateWeights.CONTEXT_NAMES, *OF_RULE, *STATE, *PAST_NAMES)
    NETWORKS: ClassVar[tuple[str, ...]] = ("remembering",)

    def policy(self, name: str, about: str = "", source: str = "") -> Policy:
        """Make the policy of these weights; it works for every L."""
        numbers = self.parameters()
        work = chains.SCRATCH[0] + int(own_numbers(numbers)), chains.SCRATCH[1]
        return Policy(
            name, on_arrival, weights=tuple(numbers.tolist()), memory=REMEMBERED, work=work, compile=True,
            built_in=True, reads_rate=True, reads_left=True, reads_past=True, about=about, source=source,
        )  # fmt: skip

    @staticmethod
    def definition(fields: Sequence[str]) -> list[Any]:
        """What defines observation and rule: weights found with others would decide nonsense."""
        past = [(field.name, field.unit, field.meaning, NOTHING[field.name]) for field in PAST_INPUTS]
        return [*CandidateWeights.definition(fields), MEANINGS, price_dp.PARAMETERS, past]

    @classmethod
    def ends(cls, settings: Mapping[str, Any]) -> tuple[int, int]:
        """How many numbers go in, and how many come out."""
        k = settings["candidates"]
        return int(seen(k)), k + 3

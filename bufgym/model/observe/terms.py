"""Built-in reward terms outside the table, computed where an environment's ``reward`` names one.

Each is a cost, hence negative: a weight > 0 rewards less of it. Steps are ``bufgym.envs.own.Step``. ``age`` and
``late`` mean the same with one queue and with several topics. There every environment has them, and the transition
counts them for each topic by the same ``age_between``; one queue has the weight 1 and a deadline of its own.
"""

import functools
from typing import Any

from bufgym.jit import kernel
from bufgym.model.observe.own import OWN_TERMS, REWARD_TERMS, RewardTerm, reward_term
from bufgym.model.topics import age_between

built_in = functools.partial(reward_term, compile=True, built_in=True)


@kernel
def delay_us(step: Any, seq: int) -> int:
    """Time from a message's arrival to the server, us."""
    return int(step.log[seq].transmitted_us + step.propagation_us - step.messages[seq].arrival_us)


@built_in("delay", unit="s")
def delay(step: Any, memory: Any) -> float:
    "minus the time from its arrival to the server, of each message that reaches it"
    total_us = 0
    for seq in step.delivered:
        total_us += delay_us(step, seq)
    return -total_us / 1e6


@built_in("energy", unit="MB")
def energy(step: Any, memory: Any) -> float:
    "minus the megabytes that the link has carried; its weight is the price of a megabyte"
    total_bytes = 0
    for seq in step.transmitted:
        total_bytes += step.messages[seq].size_bytes
    return -total_bytes / 1e6


@built_in("late", unit="messages", parameters={"deadline_s": 1.0}, one_queue=True)
def late(step: Any, memory: Any) -> float:
    "minus the weight of each message that reaches the server after its deadline; one queue: deadline_s, by default 1 s"
    count = 0
    for seq in step.delivered:
        if delay_us(step, seq) > step.parameters[0] * 1e6:
            count += 1
    return -float(count)


@built_in("age", unit="s^2", memory={"newest_us": -1.0, "until_us": 0.0}, one_queue=True)
def age(step: Any, memory: Any) -> float:
    "minus the weighted mean age of information at the server, integrated over time from the first arrival to the last"
    if len(step.messages) == 0:
        return 0.0
    if memory[0] < 0:  # before the first receipt, the first arrival counts
        memory[0] = memory[1] = step.messages[0].arrival_us
    last_us = step.messages[len(step.messages) - 1].arrival_us
    area = 0.0
    for k in range(len(step.delivered) + 1):
        until_us = last_us
        if k < len(step.delivered):
            until_us = min(step.log[step.delivered[k]].transmitted_us + step.propagation_us, last_us)
        if until_us > memory[1]:
            area += age_between(memory[0], memory[1], until_us)
            memory[1] = until_us
        if k < len(step.delivered):
            memory[0] = max(memory[0], step.messages[step.delivered[k]].arrival_us)
    return -area


@reward_term("regret", unit="QoI", one_queue=True, built_in=True)
def regret(step: Any, memory: Any) -> float:
    "change of the best H still attainable in hindsight; sums to H less the clairvoyant's H of the whole episode"
    raise AssertionError("envs.regret computes it for all rows at once")


@reward_term("cost", unit="QoI", one_queue=True, built_in=True)
def cost(step: Any, memory: Any) -> float:
    "minus what merged and growing gaps lose, as it happens; sums to H - 1 less a constant of the episode"
    raise AssertionError("envs.cost computes it for all rows at once")


@reward_term("paired", unit="QoI", one_queue=True, built_in=True)
def paired(step: Any, memory: Any) -> float:
    "cost less that of the rule `reference` on the same episode; sums to H less that rule's H"
    raise AssertionError("envs.cost computes it for all rows at once")


TOPIC_REWARD_TERMS: tuple[RewardTerm, ...] = (OWN_TERMS["age"], OWN_TERMS["late"])
"""Terms that environments with several topics compute besides; weights are fractions of their sum over the topics."""


def terms_for(several_topics: bool) -> tuple[RewardTerm, ...]:
    """The terms that every environment computes, named or not."""
    return REWARD_TERMS + (TOPIC_REWARD_TERMS if several_topics else ())

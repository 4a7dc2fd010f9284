"""Built-in reward terms outside the tables, computed where an environment's ``reward`` names one.

Each is a cost, hence negative: a weight > 0 rewards less of it. Steps are ``bufgym.envs.own.Step``.
"""

from __future__ import annotations

from typing import Any

from bufgym.model.observe.own import reward_term


@reward_term("delay", unit="s", compile=True)
def delay(step: Any, memory: Any) -> float:
    "minus the time from its arrival to the server, of each message that reaches it"
    total_us = 0
    for seq in step.delivered:
        total_us += step.log[seq].transmitted_us + step.propagation_us - step.messages[seq].arrival_us
    return -total_us / 1e6


@reward_term("energy", unit="MB", compile=True)
def energy(step: Any, memory: Any) -> float:
    "minus the megabytes that the link has carried; its weight is the price of a megabyte"
    total_bytes = 0
    for seq in step.transmitted:
        total_bytes += step.messages[seq].size_bytes
    return -total_bytes / 1e6


@reward_term("late", unit="messages", parameters={"deadline_s": 1.0}, one_queue=True, compile=True)
def late(step: Any, memory: Any) -> float:
    "minus each message that reaches the server later than deadline_s (1 s) after its arrival"
    count = 0
    for seq in step.delivered:
        delay_us = step.log[seq].transmitted_us + step.propagation_us - step.messages[seq].arrival_us
        if delay_us > step.parameters[0] * 1e6:
            count += 1
    return -float(count)


@reward_term("age", unit="s", memory={"newest_us": -1.0, "until_us": 0.0}, one_queue=True, compile=True)
def age(step: Any, memory: Any) -> float:
    "minus the age of information at the server, integrated over time (s^2), from the first arrival to the last"
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
        from_s, until_s = (memory[1] - memory[0]) / 1e6, (until_us - memory[0]) / 1e6
        if until_s > from_s:
            area += (from_s + until_s) / 2 * (until_s - from_s)
            memory[1] = until_us
        if k < len(step.delivered):
            memory[0] = max(memory[0], step.messages[step.delivered[k]].arrival_us)
    return -area

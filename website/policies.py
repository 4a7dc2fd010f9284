"""Page of policies from the registry, each with a picture of the messages that it keeps of one interruption."""

from __future__ import annotations

import numpy as np

from bufgym import oracle, policies, sim  # noqa: F401  (the oracle registers the clairvoyant)
from bufgym.policies import Policy
from bufgym.scenario import Interruption
from bufgym.scenario.numbered import draw
from bufgym.sim import metrics
from website.markdown import cited, code

T, CAPACITY = 60, 8
"""Length of the pictures' interruption in messages, and L."""

PARTS = {
    "For one queue": (
        "Each picture is the same interruption of 60 messages with L = 8. A line is a message that the server received,"
        " H the Quantity of Information of all of them (V = `exponential:0.618`). The best possible H is shown at"
        " `clairvoyant`. `make docs` draws them."
    ),
    "Only where they are named": "`bufgym bench` leaves these out unless you name them.",
    "For many topics": "These choose what to drop and what to send next: `bufgym bench --scenario topics`.",
}


def page() -> str:
    """The whole page."""
    names = (policies.names(for_topics=False), policies.names(named_only=True), policies.names(for_topics=True))
    lines = ["# Policies", "What to drop when the buffer is full. `bufgym list policies` prints the same list."]
    for (title, words), part in zip(PARTS.items(), names, strict=True):
        lines += [f"## {title}", words]
        for name in part:
            lines += _entry(policies.get(name), pictured=title != "For many topics")
    return "\n\n".join(lines)


def _entry(policy: Policy, pictured: bool) -> list[str]:
    settings = ", ".join(f"`{name}={number:g}`" for name, number in policy.parameters.items())
    facts = [f"From: {cited(policy.source)}."] if policy.source else []
    facts += [f"Settings: {settings}."] if settings else []
    facts += [f"Not ranked: {policy.unranked_because}."] if not policy.ranked else []
    lines = [f"### {policy.name}", code(policy.summary), " ".join(facts)]
    return [*lines, picture(policy)] if pictured else lines


def picture(policy: Policy) -> str:
    """Draw the messages that the policy keeps of the interruption as an SVG, with H."""
    scenario = Interruption(law="fixed", t_max=T)
    senders = sim.run(policy, [draw(scenario, 0)], CAPACITY, scenario.value)
    dropped_us = np.asarray(senders.batch.log[0])["dropped_us"][: T + 2]
    received = np.flatnonzero(dropped_us == sim.NEVER).tolist()
    ticks = "".join(f'<rect x="{10 * k}" width="6" height="24"/>' for k in received)
    words = f"{policy.name} delivers messages {', '.join(map(str, received))}"
    return (
        f'<p class="kept"><svg viewBox="0 0 {10 * (T + 2)} 24" preserveAspectRatio="none" role="img"'
        f' aria-label="{words}">{ticks}</svg><span>H = {metrics.outcome(senders, 0).qoi:.2f}</span></p>'
    )

"""The interactive page: which messages each policy keeps in one interruption or over one link, and H for each.

Everything that the page shows is computed here and written into it as JSON; the page itself only draws.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bufgym import policies, sim
from bufgym.model import qoi
from bufgym.scenario import Interruption, Scenario, get
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim import metrics
from website.picture import fading, play

POLICIES = ("drop-oldest", "afr", "min-gap", "learned")
CAPACITIES = (4, 8, 16)
LONGEST = 120
"""Messages: the longest interruption on the page."""
LINK_CAPACITY = 8
"""L over links, messages."""
_LINK_S, _LINK_SCALE = 20.0, 0.7
"""Length of an episode, s; the shipped links are made so much slower, so that there is something to drop."""
_RATES = 120
"""Points of a link's curve."""
_MARK = "/*DATA*/null"


def page() -> str:
    """The whole page: one HTML file that asks for no other."""
    template = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
    data = json.dumps(page_data(), separators=(",", ":"))
    return template.replace(_MARK, data)


def page_data() -> dict[str, Any]:
    """What the page draws.

    ``interruptions[L][policy]`` has ``kept[T - 1]``, the numbers of the messages received of 1..T, and ``h[T - 1]``;
    the last policy knows the future. ``links[name]`` has the link's ``rates`` in percent of the demand, and for each
    policy ``received`` (message k is bit k, as hexadecimal) and ``h``.
    """
    v = qoi.exponential(0.618)
    return {
        "policies": {name: policies.get(name).summary for name in (*POLICIES, "oracle", "clairvoyant")},
        "value": v.name,
        "longest": LONGEST,
        "linkCapacity": LINK_CAPACITY,
        "interruptions": {str(L): {name: interruptions(name, L) for name in (*POLICIES, "oracle")} for L in CAPACITIES},
        "links": _links(),
    }


def interruptions(name: str, capacity: int) -> dict[str, Any]:
    """What this policy keeps of interruptions of 1..LONGEST messages, and H."""
    model = Interruption(t_max=LONGEST, value=qoi.exponential(0.618))
    episodes = [model.episode(T) for T in range(1, LONGEST + 1)]
    senders = sim.run(policies.get(name), episodes, capacity, model.value)
    kept, h = [], []
    for i, T in enumerate(range(1, LONGEST + 1)):
        dropped_us = np.asarray(senders.batch.log[i])["dropped_us"][1 : T + 1]
        kept.append((np.flatnonzero(dropped_us == sim.NEVER) + 1).tolist())
        h.append(round(metrics.outcome(senders, i).qoi, 3))
    return {"kept": kept, "h": h}


def _links() -> dict[str, Any]:
    scenarios: dict[str, Scenario] = {"a fading link": fading()}
    scenarios |= dict(by_trace(get("lte", duration_s=_LINK_S, scale=(_LINK_SCALE,))))
    return {name: link(scenario) for name, scenario in scenarios.items()}


def link(scenario: Any) -> dict[str, Any]:
    """One episode over a link: the link's rate, and what each policy delivered."""
    episode = draw(scenario, 0)
    end_us = int(episode.arrivals["arrival_us"][-1])
    edges_us = np.linspace(0, end_us, _RATES + 1)
    middles_us = ((edges_us[:-1] + edges_us[1:]) / 2).astype(np.int64)
    rates = episode.link.trace.rate_bytes_per_s(middles_us + episode.link.offset_us)
    demand = scenario.size_bytes * scenario.rate_hz
    runs = play([*POLICIES, "clairvoyant"], episode, LINK_CAPACITY, scenario)
    return {
        "seconds": round(end_us / 1e6, 3),
        "messages": len(episode.arrivals),
        "rates": np.rint(100 * rates / demand).astype(int).tolist(),
        "runs": {run.policy: {"received": _bits(run.received.tolist()), "h": round(run.h, 3)} for run in runs},
    }


def _bits(numbers: list[int]) -> str:
    return f"{sum(1 << k for k in numbers):x}"

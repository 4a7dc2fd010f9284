"""Every policy beside the exact optimum without knowledge of the future, over a link small enough to solve.

``link_optimum`` defines the link, the programme and the optimum's knowledge. All policies meet the same
episodes, so differences in regret do not come from the draw of episodes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.oracle import clairvoyant
from bufgym.papers.figure import COLOURS, Figure, finish, several, whole
from bufgym.papers.link_optimum import MESSAGE, QUARTERS, Chain, cut_off, small_link
from bufgym.papers.rows import Row, Rows, listed
from bufgym.policies import Policy
from bufgym.scenario import Episode, messages
from bufgym.traces import Trace

PERIOD_US = 100_000
"""Time between arrivals. A link rate then lasts about a second, as on robots' links."""
SIZE_BYTES = 100_000
"""Size of a message. At one message per period the link carries one byte per us."""
OPTIMUM, FULL, IDLE = "optimum", "optimum, only when full", "optimum, always asked"
IDLE_UP_TO = 3
"""Largest L for which ``IDLE`` is solved too, which doubles the time."""
NAMES = ("afr", "drop-oldest", "random", "min-gap", "min-motion-gap", "paced-motion-gap")
"""Policies played beside the optimum, AFR first."""
LEARNED = ("learned-motion", "learned-time")
"""Learned policies played too."""
STYLES = {OPTIMUM: ("oracle", "-"), FULL: ("oracle", ":"), "min-gap": ("random", "-")}
STYLES |= {"learned-motion": ("sky", "--"), "paced-motion-gap": ("orange", "-")}


def episode(states: NDArray[np.int64]) -> Episode:
    """Make one message per period over a link in these states; the link is at its best once all have arrived."""
    rates = [float(QUARTERS[state]) / MESSAGE * SIZE_BYTES / PERIOD_US * 1e6 for state in states]
    steps = Trace.steps(
        [*((PERIOD_US / 1e6, rate) for rate in rates), (1.0, SIZE_BYTES / PERIOD_US * 1e6)], name="small"
    )
    trace = Trace("small", steps.time_us, steps.cumulative_bytes, "hold")
    arrival_us = np.arange(len(states)) * PERIOD_US
    return Episode(messages(arrival_us, np.full(len(states), SIZE_BYTES)), Link(trace))


@dataclass(frozen=True)
class Reproduction(Figure):
    """The optimum and every policy for each L over the same episodes."""

    capacities: Sequence[int] = (2, 3, 4)
    runs: int = 100
    arrivals: int = 100
    depth: int = 6
    stays: float = 0.9
    seed: int = 0

    RULES = {"capacities": several(whole(2, 6)), "arrivals": whole(2), "depth": whole(2, 16)}

    def simulate(self) -> Rows:
        """Return a row for each L and policy: the programme's E[H], mean H, its error, and the share of AFR's
        regret."""
        chain, v = Chain(self.stays), cut_off(qoi.exponential(0.618), self.depth)
        rng = np.random.default_rng(self.seed)
        episodes = [episode(chain.draw(self.arrivals, rng)).with_uniforms(rng) for _ in range(self.runs)]
        rows = Rows()
        for L in self.capacities:
            asked = {OPTIMUM: "busy", FULL: "full"} | ({IDLE: "always"} if L <= IDLE_UP_TO else {})
            solved = {
                name: small_link(L, v, chain, arrivals=self.arrivals, depth=self.depth, asked=where)
                for name, where in asked.items()
            }
            best = np.array([clairvoyant(each, L, v).qoi for each in episodes])
            played: dict[str, Policy] = {name: policies.get(name) for name in (*NAMES, *LEARNED)}
            played |= {name: solved[name].policy() for name in (OPTIMUM, FULL)}
            afr = None
            for name, policy in played.items():
                h = 1 + np.asarray(sim.run(policy, episodes, L, v).batch.senders["delivered_gain"])
                afr = (best - h).mean() if afr is None else afr
                row: Row = {"L": L, "policy": name, "expected": None, "idle_adds": None}
                if name in solved:
                    row["expected"] = solved[name].value
                if name == OPTIMUM and IDLE in solved:
                    row["idle_adds"] = solved[IDLE].value - solved[name].value
                row |= {"qoi": h.mean(), "error": h.std() / max(1, self.runs - 1) ** 0.5, "clairvoyant": best.mean()}
                rows.append(row | {"share": (best - h).mean() / afr if afr > 0 else math.nan})
        return rows

    def tables(self, rows: Rows) -> list[str]:
        order = sorted(rows.distinct("policy"), key=lambda name: rows.mean("share", policy=name))
        ranked = Rows(row for name in order for row in rows.where(policy=name))
        return ranked.pivot("policy", "L", "share", ".3f", {L: f"L = {L}" for L in self.capacities})

    def claims(self, rows: Rows) -> dict[str, Any]:
        exact = Rows(row for row in rows if row["expected"] is not None)
        z = np.abs(exact.column("expected") - exact.column("qoi")) / np.maximum(exact.column("error"), 1e-9)
        optimum, full = (rows.column("share", policy=name) for name in (OPTIMUM, FULL))
        others = [name for name in rows.distinct("policy") if name not in (OPTIMUM, FULL)]
        best_other = np.min([rows.column("share", policy=name) for name in others], axis=0)
        return {
            "exact": bool((z < 4).all()),
            "order": bool((optimum <= best_other).all() and (optimum >= 0).all()),
            "room": bool(((full - optimum) > 0.1).all()),
            "worst_z": float(z.max()),
            "idle": float(np.nanmax([0.0, *rows.column("idle_adds", policy=OPTIMUM)])),
            "capacities_text": listed(self.capacities),
            "optimum": listed([f"{share:.2f}" for share in optimum]),
            "full": listed([f"{share:.2f}" for share in full]),
            "best_other": listed([f"{share:.2f}" for share in best_other]),
        }

    def draw(self, rows: Rows, figure: Any) -> None:
        axes = figure.add_subplot()
        for name, (colour, line) in STYLES.items():
            shares = rows.column("share", policy=name)
            axes.plot(self.capacities, shares, line, marker="o", markersize=4, color=COLOURS[colour], label=name)
        axes.axhline(1, color=COLOURS["afr"], linewidth=1.3, label="afr")
        finish(axes, "Regret beside AFR's, link of 0, 1/4, 1/2 or 1 message a period", xlabel="L, messages")
        axes.set(ylabel="share of AFR's regret", ylim=(0, 1.1), xticks=list(self.capacities))
        figure.legend(loc="outside right center", frameon=False)

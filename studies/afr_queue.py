"""Messages that Drop Oldest, Random and AFR still hold when the link returns after one interruption.

The picture shows the problem, as the AFR paper's first figures do. Drop Oldest loses the whole beginning, Random leaves
random gaps, and AFR thins evenly. Message 0, sent before the interruption, and message T + 1, sent after it, are always
received.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym import policies, sim
from bufgym.scenario import Interruption
from bufgym_papers.figures.figure import COLOURS, Figure, finish, legend_below, whole
from bufgym_papers.figures.rows import FigureRows

POLICIES = {"drop-oldest": "Drop Oldest", "random": "Random", "afr": "AFR"}


@dataclass(frozen=True)
class Reproduction(Figure):
    """Figure of one interruption of T = ``last_T`` messages with L = ``capacity``."""

    capacity: int = 8
    last_T: int = 26
    seed: int = 0  # seed of Random's draws

    RULES = {"last_T": whole(2)}
    SIZE_INCHES = (10.0, 4.2)

    def simulate(self) -> FigureRows:
        """Return a row for each policy and message: the arrival at which the message was dropped, or None."""
        interruption = Interruption(law="fixed", t_max=self.last_T)
        rng = np.random.Generator(np.random.PCG64(self.seed))
        episode = interruption.episode(self.last_T).with_uniforms(rng)
        rows = FigureRows()
        for policy in POLICIES:
            senders = sim.run(policies.get(policy), [episode], self.capacity, interruption.value)
            dropped_us = np.asarray(senders.batch.log[0])["dropped_us"]
            for message, at_us in enumerate(dropped_us[: self.last_T + 2].tolist()):
                dropped_at = None if at_us == sim.NEVER else round(at_us / interruption.period_us)
                rows.append({"policy": policy, "message": message, "dropped_at": dropped_at})
        return rows

    def received(self, rows: FigureRows, policy: str) -> list[int]:
        """List the numbers of the messages received, including 0 and T + 1."""
        return [row["message"] for row in rows.where(policy=policy, dropped_at=None)]

    def tables(self, rows: FigureRows) -> list[str]:
        return [f"{label:12} {' '.join(map(str, self.received(rows, p)))}" for p, label in POLICIES.items()]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        longest = {policy: int(np.diff(self.received(rows, policy)).max()) for policy in POLICIES}
        return {
            "order": longest["afr"] <= longest["random"] <= longest["drop-oldest"],
            **{f"{policy.removeprefix('drop-')}_gap": gap for policy, gap in longest.items()},
            "ideal_gap": (self.last_T + 1) / (min(self.capacity, self.last_T) + 1),
        }

    def draw(self, rows: FigureRows, figure: Any) -> None:
        panels = figure.subplots(1, len(POLICIES), sharey=True)
        end = self.last_T + 1
        for axes, (policy, label) in zip(panels, POLICIES.items(), strict=True):
            colour, grey = COLOURS[policy], COLOURS["other"]
            for row in rows.where(policy=policy):
                message, dropped_at = row["message"], row["dropped_at"]
                style = {"linewidth": 1.4, "color": grey if dropped_at is not None else colour}
                axes.plot([message, end if dropped_at is None else dropped_at], [message, message], **style)
                if dropped_at is not None:
                    axes.plot(dropped_at, message, "x", color=grey, markersize=5)
            received = self.received(rows, policy)
            axes.plot([end + 0.8] * len(received), received, "<", color=colour, markersize=5)
            finish(axes, label, xlabel="arrivals since the link stopped", xlim=(-0.5, end + 2))
        panels[0].set_ylabel("message")
        panels[0].plot([], [], color=COLOURS["other"], marker="x", label="queued, then dropped")
        panels[0].plot([], [], color=COLOURS["oracle"], marker="<", label="queued until the link returns: received")
        legend_below(figure, 2, panels[0])

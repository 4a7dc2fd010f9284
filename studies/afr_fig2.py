"""After Fig. 2 of the AFR paper: the parts of a robot that streams to a server, under the names they have in bufgym."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym import policies, sim
from bufgym.scenario import Interruption
from bufgym_papers.figures.figure import COLOURS, Figure
from bufgym_papers.figures.rows import FigureRows

PARTS = (
    ("robot", "Sensors, Sender", "scenario: messages\nwith time, bytes, x"),
    ("robot", "Queue", "model.buffer: at most L;\na policy says what goes"),
    ("robot", "Socket", "sim.socket: one message\nat a time, as over TCP"),
    ("link", "wireless network", "model.link: a trace,\nexact to the microsecond"),
    ("server", "Receiver", "sim.metrics: what came,\nH = 1 + sum of V"),
    ("server", "applications", "papers.perception: a map,\na track"),
)
"""Where a part is, its name in the paper, and what it is here."""
PLAYED = ("drop-oldest", "random", "afr")


@dataclass(frozen=True)
class Reproduction(Figure):
    """The diagram, and a check that only the queue drops."""

    capacity: int = 8
    last_T: int = 60
    SIZE_INCHES = (12.0, 2.8)

    def simulate(self) -> FigureRows:
        """Return a row for each policy: messages dequeued in interruptions of all lengths, and arrivals."""
        interruption = Interruption(law="fixed", t_max=self.last_T)
        rng = np.random.Generator(np.random.PCG64(0))
        episodes = [interruption.episode(T).with_uniforms(rng) for T in range(1, self.last_T + 1)]
        rows = FigureRows()
        for policy in PLAYED:
            counts = sim.run(policies.get(policy), episodes, self.capacity, interruption.value).batch.senders
            columns = {"dequeued": int(counts["dequeued"].sum()), "delivered": int(counts["credited"].sum())}
            rows.append({"policy": policy, **columns})
        return rows

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        dequeued, delivered = (int(rows.column(name).sum()) for name in ("dequeued", "delivered"))
        names = ", ".join(PLAYED)
        return {"kept": dequeued == delivered, "dequeued": dequeued, "lost": dequeued - delivered, "policies": names}

    def draw(self, rows: FigureRows, figure: Any) -> None:
        axes = figure.add_subplot()
        colours = {"robot": COLOURS["afr"], "link": COLOURS["other"], "server": COLOURS["random"]}
        for k, (place, name, ours) in enumerate(PARTS):
            style = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": colours[place]}
            axes.text(2 * k, 0, name, ha="center", va="center", fontsize=10, weight="bold", bbox=style)
            axes.text(2 * k, -0.55, ours, ha="center", va="top", fontsize=8)
            if k + 1 < len(PARTS):
                axes.annotate("", (2 * k + 1.25, 0), (2 * k + 0.75, 0), arrowprops={"arrowstyle": "->"})
        for place, middle in (("robot", 2), ("server", 9)):
            axes.text(middle, 0.7, place, ha="center", fontsize=11, color=colours[place])
        axes.set(xlim=(-1.2, 2 * len(PARTS) - 0.8), ylim=(-1.4, 1.0))
        axes.set_axis_off()

"""Fig. 4 of the AFR paper [wang2022afr]: which messages AFR keeps as an interruption grows, step by step.

Message 0 is in transmission when the link stops; message T is the T-th to arrive after that. With L = 8, the messages 9
to 16 evict 1, 3, ..., 15, which is one pass of the dropping position p over the queue. Then the dropping rate r
doubles. The counter c now rejects every second arrival, and the next pass begins.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.model.buffer import REJECT, Buffer
from bufgym.policies.afr import C, P, R
from bufgym.scenario import Interruption
from bufgym.utils.tables import aligned
from bufgym_papers.figures.figure import COLOURS, Figure, finish, legend_below
from bufgym_papers.figures.rows import FigureRows, listed

PAPER_L = 8
PAPER_T = (8, 18)  # First and last T of the figure
PAPER_DROPS = {9: 1, 10: 3, 11: 5, 12: 7, 13: 9, 14: 11, 15: 13, 16: 15, 17: 17, 18: 2}
"""T -> the message that the figure strikes out; 17 is the newcomer itself."""


class AfrStep(NamedTuple):
    """AFR's decision on arrival T, counted from the link's stop, and its state afterwards: rate, counter, position.

    ``dropped`` is T if the newcomer was rejected, None if nothing was dropped. ``kept`` is the queue, oldest first.
    """

    T: int
    dropped: int | None
    r: int
    c: int
    p: int
    kept: tuple[int, ...]


def steps(capacity: int = PAPER_L, last_T: int = PAPER_T[1], policy: str = "afr") -> list[AfrStep]:
    """Run the simulator and return AFR's decisions 1..``last_T`` with L = ``capacity``."""
    afr = policies.get(policy)
    watched: list[AfrStep] = []

    def watch(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
        decision = afr.on_arrival(buffer, arrival, memory)
        kept = [int(seq) for seq in buffer.slots["seq"]]
        T, dropped = int(arrival.seq), None
        if decision == REJECT:
            dropped = T
        else:
            if decision >= 0:
                dropped = kept.pop(decision)
            kept.append(T)
        watched.append(AfrStep(T, dropped, int(memory[R]), int(memory[C]), int(memory[P]), tuple(kept)))
        return decision

    # Runs uncompiled so that the watcher sees each decision; the transition function is the same.
    watcher = replace(afr, name=f"{afr.name}-watched", on_arrival=watch, compile=False)
    episode = Interruption(law="fixed", t_max=last_T).episode(last_T)
    sim.run(watcher, [episode], capacity, Interruption().value)
    return watched


@dataclass(frozen=True)
class Reproduction(Figure):
    """Fig. 4 for the paper's L = 8 and T from 8 to 18."""

    SIZE_INCHES = (7.5, 5.3)

    def simulate(self) -> FigureRows:
        kept = (step for step in steps() if step.T >= PAPER_L)
        return FigureRows(step._asdict() | {"kept": " ".join(map(str, step.kept))} for step in kept)

    def tables(self, rows: FigureRows) -> list[str]:
        lines: list[list[object]] = [["T", "drops", "paper", "r", "c", "p", "kept"]]
        for row in rows:
            T, dropped = row["T"], row["dropped"]
            note = "  (newcomer rejected by the counter)" if dropped == T else ""
            lines.append([T, dropped or "-", PAPER_DROPS.get(T, "-"), row["r"], row["c"], row["p"], row["kept"] + note])
        return aligned(lines, left=7)

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        same = [row["dropped"] == PAPER_DROPS[row["T"]] for row in rows if row["T"] in PAPER_DROPS]
        path = itertools.pairwise(steps(last_T=40))
        doubled = [step.T for before, step in path if step.r > before.r and step.p == 0]
        drops = {"drops": all(same), "same": sum(same), "compared": len(same)}
        return drops | {"doubles": doubled == [16, 32], "doubled": listed([str(T) for T in doubled])}

    def draw(self, rows: FigureRows, figure: Any) -> None:
        axes = figure.add_subplot()
        for row in rows:
            kept = [int(seq) for seq in row["kept"].split()]
            axes.plot(kept, [row["T"]] * len(kept), "o", color=COLOURS["afr"], markersize=8)
            if row["dropped"] is not None:
                cross = {"color": COLOURS["drop-oldest"], "markersize": 8, "markeredgewidth": 2}
                axes.plot(row["dropped"], row["T"], "x", **cross)
            state, place = "r={r} c={c} p={p}".format(**row), (PAPER_T[1] + 0.8, row["T"])
            axes.annotate(state, place, va="center", fontsize=8, backgroundcolor="white")
        axes.plot([], [], "o", color=COLOURS["afr"], label="kept")
        axes.plot([], [], "x", color=COLOURS["drop-oldest"], markeredgewidth=2, label="dropped at this T")
        finish(axes, f"AFR, L = {PAPER_L}: messages kept as the interruption grows", xlim=(0.3, PAPER_T[1] + 3.6))
        axes.set(xlabel="message", ylabel="T, messages since the link stopped")
        axes.set(xticks=range(1, PAPER_T[1] + 1), yticks=rows.distinct("T"))
        axes.invert_yaxis()
        legend_below(figure, 2)

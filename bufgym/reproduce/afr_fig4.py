"""Fig. 4 of the AFR paper: which messages AFR keeps as an interruption grows, step by step.

Message 0 is in transmission when the link stops; message T is the T-th to arrive since. With L = 8 messages 9 to 16
push out 1, 3, ..., 15: one pass of the dropping position p over the queue. Then the dropping rate r doubles: every
second arrival is rejected by the counter c, and the next pass begins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym import sim as sender
from bufgym.errors import BufgymError
from bufgym.model.buffer import REJECT, Buffer
from bufgym.policies.afr import C, P, R
from bufgym.reproduce.report import COLOURS, Report
from bufgym.scenario import Interruption

PAPER_L = 8
PAPER_T = (8, 18)
"""First and last T of the figure."""
PAPER_DROPS = {9: 1, 10: 3, 11: 5, 12: 7, 13: 9, 14: 11, 15: 13, 16: 15, 17: 17, 18: 2}
"""T -> the message that the figure strikes out (17 is the newcomer itself)."""


@dataclass(frozen=True)
class Step:
    """What AFR did with one arrival, and its state afterwards."""

    T: int
    """Number of the arrival, and of the messages that came since the link stopped."""
    dropped: int | None
    """Number of the message that went; T itself if the newcomer was rejected, None if all fitted."""
    r: int
    """Dropping rate."""
    c: int
    """Counter."""
    p: int
    """Dropping position."""
    kept: tuple[int, ...]
    """Numbers of the queued messages, oldest first."""


def steps(capacity: int = PAPER_L, last_T: int = PAPER_T[1], policy: str = "afr") -> list[Step]:
    """AFR's decisions 1..``last_T`` with L = ``capacity``, taken from a run of the simulator."""
    afr = policies.get(policy)
    seen: list[Step] = []

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
        seen.append(Step(T, dropped, int(memory[R]), int(memory[C]), int(memory[P]), tuple(kept)))
        return decision

    # Uncompiled, so that the watcher sees each decision; the transition is the same.
    watched = replace(afr, name=f"{afr.name}-watched", on_arrival=watch, compile=False)
    episode = Interruption(law="fixed", t_max=last_T).episode(last_T)
    sender.run(watched, [episode], capacity, Interruption().value)
    return seen


def report(capacity: int = PAPER_L, last_T: int = PAPER_T[1]) -> Report:
    """Fig. 4 for L = ``capacity`` and T from L to ``last_T`` (the paper: 8, and 8 to 18)."""
    if last_T < capacity:
        raise BufgymError(f"last_T = {last_T}: must be at least L = {capacity}")
    shown = [step for step in steps(capacity, last_T) if step.T >= capacity]
    as_paper = capacity == PAPER_L
    lines = [
        f"AFR paper, Fig. 4: what AFR keeps, L = {capacity}. State r, c, p is that after the decision.",
        "",
        "  T  drops  paper   r   c   p  kept",
    ]
    for step in shown:
        paper = PAPER_DROPS.get(step.T) if as_paper else None
        lines.append(
            f"{step.T:3d}  {_or_dash(step.dropped):>5}  {_or_dash(paper):>5} {step.r:3d} {step.c:3d} {step.p:3d}  "
            f"{' '.join(map(str, step.kept))}"
            + ("  (newcomer rejected by the counter)" if step.dropped == step.T else "")
        )
    if as_paper:
        compared = [step for step in shown if step.T in PAPER_DROPS]
        same = sum(step.dropped == PAPER_DROPS[step.T] for step in compared)
        lines += ["", f"{same} of {len(compared)} drops as in the paper"]
    rows = [[s.T, _or_dash(s.dropped), s.r, s.c, s.p, " ".join(map(str, s.kept))] for s in shown]

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        for step in shown:
            axes.plot(step.kept, [step.T] * len(step.kept), "o", color=COLOURS["afr"], markersize=8)
            if step.dropped is not None:
                axes.plot(step.dropped, step.T, "x", color=COLOURS["drop-oldest"], markersize=8, markeredgewidth=2)
            axes.annotate(
                f"r={step.r} c={step.c} p={step.p}",
                (last_T + 0.8, step.T),
                va="center",
                fontsize=8,
                backgroundcolor="white",
            )
        axes.plot([], [], "o", color=COLOURS["afr"], label="kept")
        axes.plot([], [], "x", color=COLOURS["drop-oldest"], markeredgewidth=2, label="dropped at this T")
        axes.set(xlim=(0.3, last_T + 3.6), xlabel="message", ylabel="T, messages since the link stopped")
        axes.set_xticks(range(1, last_T + 1, 1 if last_T <= 24 else 4))
        axes.set_yticks([s.T for s in shown][:: 1 if len(shown) <= 24 else 4])
        axes.invert_yaxis()
        axes.set_title(f"AFR, L = {capacity}: messages kept as the interruption grows", loc="left")
        axes.grid(alpha=0.25)
        axes.set_axisbelow(True)
        figure.legend(loc="outside lower center", ncols=2, frameon=False)

    header = ["T", "dropped", "r", "c", "p", "kept"]
    return Report("\n".join(lines), header, rows, draw, (7.5, 0.34 * len(shown) + 1.6))


def _or_dash(number: int | None) -> str:
    return "-" if number is None else str(number)

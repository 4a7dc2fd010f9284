"""Sec. III and IV of the AFR paper [wang2022afr], sentence by sentence: the model, the problem, Algorithm 1, Eq. 9."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.policies.registry import Policy
from bufgym.scenario import Interruption, Streams
from bufgym.scenario.afr_evaluation import evaluation, fade
from bufgym.sim import metrics
from bufgym_papers.figures.afr_fig9 import full_queue, inside_us
from bufgym_papers.figures.afr_theorems import gaps_of
from bufgym_papers.figures.figure import COLOURS, Figure, finish
from bufgym_papers.figures.rows import FigureRows

R, THRESHOLD = 2, 2 / 3
"""Algorithm 1 doubles and halves r, and halves it where less than this share of the queue is taken."""
NESTED = ("afr", "drop-oldest", "min-gap")
SIZES = (8, 64, 512, 4096)  # L at which AFR's decision is timed
CONSTANT = 2.0  # Most that the time of a decision may grow over ``SIZES`` for O(1)
ERRORS = 4.5  # Most standard errors by which a frequency of ``runs`` may miss its probability


class Algorithm1:
    """The paper's Algorithm 1, line by line; ``enqueue`` returns the place that is dropped, or -1 for the newcomer."""

    def __init__(self, capacity: int) -> None:
        self.L, self.r, self.c, self.p = capacity, 1, 0, 0

    def enqueue(self, queued: int) -> int | None:
        if self.r > 1 and queued / self.L < THRESHOLD:  # lines 2 to 4
            self.r //= R
            self.c %= self.r
        self.c += 1  # line 5
        if self.c != self.r:
            return -1
        self.c, dropped = 0, None  # line 8
        if queued == self.L:  # lines 9 to 14
            dropped = self.p
            self.p += 1
            if self.p == self.L:
                self.r, self.p = self.r * R, 0
        return dropped


def differing_decisions(capacity: int) -> tuple[int, int]:
    """(Decisions of ``afr-paper`` that are not Algorithm 1's, all decisions) on the evaluation over a fading link."""
    paper, ours = Algorithm1(capacity), policies.get("afr-paper")
    seen: list[bool] = []

    def both(buffer: Any, arrival: Any, memory: NDArray[np.float64]) -> int:
        decision = ours.on_arrival(buffer, arrival, memory)
        expected = paper.enqueue(len(buffer.slots))
        seen.append(decision == {-1: policies.REJECT, None: policies.ACCEPT}.get(expected, expected))
        return int(decision)

    memory = dict(zip(("r", "c", "p"), (1.0, 0.0, 0.0), strict=True))
    scenario = evaluation(fade())
    sim.run(Policy("both", both, memory=memory), [scenario.draw(Streams.seeded(0))], capacity, scenario.value)
    return seen.count(False), len(seen)


@dataclass(frozen=True)
class Reproduction(Figure):
    """The probability that Random keeps message i, and what else the two sections say."""

    capacity: int = 8
    last_T: int = 26
    runs: int = 10_000
    seed: int = 0
    SIZE_INCHES = (7.0, 3.6)

    def simulate(self) -> FigureRows:
        """Return a row for each message: how often Random keeps it, and the probability of Eq. 9."""
        interruption, L, T = Interruption(law="fixed", t_max=self.last_T), self.capacity, self.last_T
        rng = np.random.Generator(np.random.PCG64(self.seed))
        episodes = [interruption.episode(T).with_uniforms(rng) for _ in range(self.runs)]
        log = sim.run(policies.get("random"), episodes, L, interruption.value).batch.log
        kept = (np.asarray(log["dropped_us"])[:, 1 : T + 1] == sim.NEVER).mean(axis=0)
        eq_9 = [(L / (L + 1)) ** min(T - i + 1, T - L) for i in range(1, T + 1)]
        pairs = enumerate(zip(kept.tolist(), eq_9, strict=True), 1)
        return FigureRows({"message": i, "kept": ours, "eq_9": paper} for i, (ours, paper) in pairs)

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        kept, paper = rows.column("kept"), rows.column("eq_9")
        errors = np.abs(kept - paper) / np.sqrt(paper * (1 - paper) / self.runs)
        lengths = range(1, self.last_T + 1)
        most = {name: self.most_kept(name) for name in NESTED}
        wrong, decisions = differing_decisions(self.capacity)
        times = {L: inside_us(policies.get("afr"), *full_queue(L, 64), 20_000) for L in SIZES}
        return {
            "eq-2": (off := self.off_from_the_sum()) < 1e-9,
            "off": off,
            "eq-7": max(most.values()) <= self.capacity,
            "most": max(most.values()),
            "eq-8": not (lost := [name for name in NESTED if not self.is_nested(name, lengths)])
            and not self.is_nested("oracle", lengths),
            "lost": ", ".join(lost) or "none",
            "eq-9": float(errors.max()) < ERRORS,
            "errors": float(errors.max()),
            "algorithm-1": wrong == 0,
            "wrong": wrong,
            "decisions": decisions,
            "constant": max(times.values()) <= CONSTANT * times[SIZES[0]],
            "times": ", ".join(f"{1e3 * us:.0f} ns at L = {L}" for L, us in times.items()),
        }

    def off_from_the_sum(self) -> float:
        """Largest difference between the simulator's H and Eq. 2 for the messages received, over ``NESTED``."""
        scenario, off = Interruption(law="fixed", t_max=self.last_T), 0.0
        for name in NESTED:
            senders = sim.run(policies.get(name), [scenario.episode(self.last_T)], self.capacity, scenario.value)
            gaps = np.diff(metrics.received(senders, 0)["seq"])
            counted = 1 + float(senders.batch.senders["delivered_gain"][0])  # as the transition adds it up
            added = (scenario.value.information([0.0, float(gap)]) - 1 for gap in gaps)  # V of each gap by itself
            off = max(off, abs(1 + sum(added) - counted))
        return off

    def most_kept(self, name: str) -> int:
        """Most messages of an interruption that the policy still has when the link returns."""
        return max(len(gaps) - 1 for gaps in gaps_of(name, self.capacity, range(1, self.last_T + 1)))

    def is_nested(self, name: str, lengths: range) -> bool:
        """Whether what the policy keeps at T was kept at T - 1, or is T."""
        sets = [set(np.cumsum(gaps)[:-1].tolist()) for gaps in gaps_of(name, self.capacity, lengths)]
        return all(now <= before | {T} for T, (before, now) in enumerate(itertools.pairwise(sets), 2))

    def draw(self, rows: FigureRows, figure: Any) -> None:
        axes = figure.add_subplot()
        axes.plot(rows.column("message"), rows.column("eq_9"), color=COLOURS["random"], label="Eq. 9")
        axes.plot(rows.column("message"), rows.column("kept"), "o", color=COLOURS["other"], label=f"{self.runs:,} runs")
        title = f"Random: part of runs in which message i is kept, L = {self.capacity}, T = {self.last_T}"
        finish(axes, title, xlabel="message i", ylim=(0, 1))
        axes.legend(frameon=False)

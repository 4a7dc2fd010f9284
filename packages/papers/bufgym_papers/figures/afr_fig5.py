"""Fig. 5 of the AFR paper [wang2022afr]: information gained in an interruption against its length T.

L = 8 and V(d) = 1 - 0.618^d, a camera moving back from a wall. The information gained is H - 1, because the paper
leaves out message 0, which was sent before. Random's band is one standard deviation over its runs.

AFR equals oracle-ideal where its L + 1 gaps are equal, that is T + 1 = (L + 1) 2^k. For L = 8 these are T = 17, 35 and
71. The paper prints 18, 36 and 72, where AFR is strictly below oracle-ideal.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.benchmark.rows import Row
from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym.oracle import interruption as oracle
from bufgym.scenario import Episode, Interruption
from bufgym_papers.figures.figure import COLOURS, Figure, about, finish, whole
from bufgym_papers.figures.rows import FigureRows, listed

PAPER_L = 8
PAPER_RUNS = 10_000  # Runs of Random for each T
PAPER_PEAKS = (18, 36, 72)
"""T at which the paper says that AFR equals the oracle. The equality holds for these values of T + 1."""

MEAN_OVER = (9, 399)
"""First and last T of the printed mean of (H - 1) / oracle: from L + 1 to the end of a table of 400."""
EQUAL = 1e-12  # Relative difference up to which two sums of V count as equal; it covers rounding only
BATCH = 1000  # Senders per batch; a batch fits in the processor's cache

CURVES = {
    "oracle-ideal": ("oracle-ideal", ":"),
    "oracle": ("oracle", "--"),
    "afr": ("AFR", "-"),
    "drop-oldest": ("Drop Oldest", "-"),
    "random": ("Random, mean ± 1 sd", "-"),
}
"""Column -> label and line style."""


def gained(policy: str, episodes: Sequence[Episode], capacity: int, v: Value) -> NDArray[np.float64]:
    """Return H - 1 of each episode under ``policy``, float64[episodes]."""
    senders = sim.run(policies.get(policy), episodes, capacity, v)
    return np.array(senders.batch.senders["delivered_gain"])


def gained_at_random(
    interruption: Interruption, T: int, capacity: int, runs: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return H - 1 of ``runs`` independent runs of Random over an interruption of T messages, float64[runs]."""
    episode = interruption.episode(T)
    batches = ([episode.with_uniforms(rng) for _ in range(min(BATCH, runs - k))] for k in range(0, runs, BATCH))
    return np.concatenate([gained("random", batch, capacity, interruption.value) for batch in batches])


def mean_score(policy: str, capacity: int, first: int, last: int) -> float:
    """Return the mean of (H - 1) / oracle over T = ``first``..``last`` for V(d) = 1 - 0.618^d."""
    v = qoi.exponential(0.618)
    interruption = Interruption(law="fixed", t_max=last, value=v)
    lengths = range(first, last + 1)
    gains = gained(policy, [interruption.episode(T) for T in lengths], capacity, v)
    return float(np.mean(gains / [oracle.integer(capacity, T, v) for T in lengths]))


@dataclass(frozen=True)
class Reproduction(Figure):
    """Fig. 5 for T = 1..``last_T``, with ``runs`` runs of Random for each T."""

    runs: int = PAPER_RUNS
    last_T: int = 80
    seed: int = 0

    RULES = {"runs": whole(2)}

    def simulate(self) -> FigureRows:
        v = qoi.exponential(0.618)
        interruption = Interruption(law="fixed", t_max=self.last_T, value=v)
        rng = np.random.Generator(np.random.PCG64(self.seed))
        lengths = range(1, self.last_T + 1)
        episodes = [interruption.episode(T) for T in lengths]
        samples = [gained_at_random(interruption, T, PAPER_L, self.runs, rng) for T in lengths]
        afr, drop_oldest = (gained(policy, episodes, PAPER_L, v) for policy in ("afr", "drop-oldest"))
        rows = FigureRows()
        for T, ours, oldest, sample in zip(lengths, afr, drop_oldest, samples, strict=True):
            row: Row = {"T": T, "oracle-ideal": oracle.ideal(PAPER_L, T, v), "oracle": oracle.integer(PAPER_L, T, v)}
            row |= {"afr": float(ours), "drop-oldest": float(oldest)}
            mean, sd = float(sample.mean()), float(sample.std(ddof=1))
            rows.append(
                row | {"random": mean, "random_sd": sd, "random_within": float((abs(sample - mean) <= sd).mean())}
            )
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        shown = sorted({1, 8, 9, 17, 18, 25, 35, 36, 50, 71, 72, self.last_T} & set(rows.distinct("T")))
        numbers = {name: (name, ".4f") for name in CURVES} | {"sd random": ("random_sd", ".4f")}
        return FigureRows(rows[T - 1] for T in shown).listing({"T": ("T", "")} | numbers, left=0)

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        afr_mean, oldest_mean = (mean_score(policy, PAPER_L, *MEAN_OVER) for policy in ("afr", "drop-oldest"))
        printed = [row for row in rows if row["T"] in PAPER_PEAKS]
        peaks = equal_lengths(rows)
        beyond = [row for row in rows if row["T"] > PAPER_L]
        ordered = [
            row["drop-oldest"] * (1 - EQUAL) <= row["random"] <= min(row["afr"], row["oracle-ideal"]) * (1 + EQUAL)
            for row in beyond
        ]
        best = rows.column("oracle")
        near = np.array([row["random_within"] for row in beyond if row["random_sd"] > EQUAL])
        return {
            "never": bool((np.diff(best) > 0).all() and best.max() < PAPER_L + 1),
            "best": best.max(),
            "within": bool(about(0.68)[0] <= near.mean() <= about(0.68)[1]) if len(near) else None,
            "near": f"{near.mean():.1%} on average, from {near.min():.0%} to {near.max():.0%} at single T"
            if len(near)
            else "not run",
            "equal": peaks == list(PAPER_PEAKS),
            "order": all(ordered) if ordered else None,
            "ordered": sum(ordered),
            "lengths": len(ordered),
            "peaks": listed(peaks),
            "paper_peaks": listed(PAPER_PEAKS),
            "below": listed([f"{row['T']}: {row['afr'] / row['oracle-ideal']:.5f}" for row in printed]),
            "afr_mean": afr_mean,
            "oldest_mean": oldest_mean,
        }

    def draw(self, rows: FigureRows, figure: Any) -> None:
        axes = figure.add_subplot()
        lengths, random, spread = (rows.column(name) for name in ("T", "random", "random_sd"))
        axes.fill_between(lengths, random - spread, random + spread, color=COLOURS["random"], alpha=0.2, linewidth=0)
        for name, (label, line) in CURVES.items():
            axes.plot(lengths, rows.column(name), line, color=COLOURS[name], label=label, linewidth=1.6)
        peaks = equal_lengths(rows)
        heights = [rows[T - 1]["afr"] for T in peaks]
        axes.plot(peaks, heights, "o", color=COLOURS["afr"], markersize=6, label="AFR = oracle-ideal")
        finish(axes, "Information gained in one interruption, L = 8, V(d) = 1 − 0.618$^d$")
        axes.set(xlabel="T, messages during the interruption", ylabel="information gained, H − 1")
        axes.set(xlim=(0, self.last_T + 1), ylim=(0, PAPER_L + 2))
        axes.legend(loc="lower right", frameon=False, ncols=2)


def equal_lengths(rows: FigureRows) -> list[int]:
    return [r["T"] for r in rows if r["T"] > PAPER_L and r["oracle-ideal"] - r["afr"] <= EQUAL * r["oracle-ideal"]]

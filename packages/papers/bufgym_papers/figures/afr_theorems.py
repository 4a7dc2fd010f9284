"""Theorems of the AFR paper [wang2022afr], checked on the simulator for every L, T and V of a grid.

See packages/papers/bufgym_papers/figures/README.md, "The theorems of AFR, exactly".
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.benchmark.rows import Row
from bufgym.scenario import Interruption
from bufgym.sim import metrics
from bufgym_papers.figures.figure import COLOURS, Figure, finish, whole
from bufgym_papers.figures.rows import FigureRows

ROUNDING = 1e-12  # Relative tolerance of comparisons that are not between integers

LEMMA_SUM = 200  # Largest sum of two gaps for which Lemma 1 is checked

VIOLATIONS = ("above_oracle", "oracle_above_ideal", "below_bound", "below_sharper", "below_oldest", "uneven", "unequal")
"""Columns that each count the violations of one statement."""


def bound(capacity: int) -> float:
    """Lower bound on AFR / oracle-ideal for every T and V, Theorem 2 of the paper."""
    return 2 * (math.sqrt(2) - 1) * capacity / (capacity + 1)


def sharper_bound(capacity: int) -> float:
    """Lower bound above the paper's; the two meet as L grows."""
    return 2 * (math.sqrt((2 * capacity + 1) / (capacity + 1)) - 1)


def gaps_of(policy: str, capacity: int, lengths: Sequence[int]) -> list[NDArray[np.int64]]:
    """Return the gaps between the messages received, including 0 and T + 1, for each T; V does not matter."""
    interruption = Interruption(law="fixed", t_max=max(lengths))
    senders = sim.run(policies.get(policy), [interruption.episode(T) for T in lengths], capacity, interruption.value)
    return [np.diff(metrics.received(senders, i)["seq"]) for i in range(len(lengths))]


def best_gaps(capacity: int, T: int) -> NDArray[np.int64]:
    """Return the gaps of the integer oracle, which are as equal as integers can be."""
    q, longer = divmod(T + 1, min(capacity, T) + 1)
    return np.array([q + 1] * longer + [q] * (min(capacity, T) + 1 - longer), np.int64)


def extremes(gaps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return H - 1 for V(d) = min(d, D), D = 1, 2, ..., which stand for every concave V; int64[gaps.sum()]."""
    longer = np.bincount(gaps, minlength=int(gaps.sum()) + 1)[::-1].cumsum()[::-1]  # gaps of each size and longer
    return np.asarray(longer[1:].cumsum())


def worst_ratio(gaps: NDArray[np.int64]) -> float:
    """Smallest (H - 1) / oracle-ideal of these gaps under any V that satisfies Eq. 3-6; see the module."""
    return float(np.minimum(1, gaps / gaps.mean()).mean())


def lemma_violations() -> int:
    """Pairs of gaps of equal sums for which the more even pair gains less, over V(d) = min(d, D); see Lemma 1."""
    d, count = np.arange(1, LEMMA_SUM), 0
    for total in range(2, LEMMA_SUM + 1):
        a = np.arange(1, total // 2 + 1)  # the smaller gap of each pair, from the least even pair on
        gains = np.minimum(a, d[:, None]) + np.minimum(total - a, d[:, None])
        count += int((np.diff(gains, axis=1) < 0).sum())
    return count


def kept_by_oracle(capacity: int, T: int) -> list[int]:
    """The messages that Oracle keeps: T of the interruption is told beforehand."""
    return [int(seq) for seq in np.cumsum(gaps_of("oracle", capacity, [T])[0])[:-1]]


def even_enough(gaps: NDArray[np.int64]) -> bool:
    """Check that the largest gap between kept messages is <= 2 x the smallest and the edge's gap <= the smallest."""
    inner, edge = gaps[:-1], gaps[-1]
    return bool(gaps.max() <= 2 * inner.min() and edge <= inner.min())


@dataclass(frozen=True)
class Reproduction(Figure):
    """Check of the theorems over L = 1..``max_capacity``, T = 1..``last_T`` and every V."""

    max_capacity: int = 32
    last_T: int = 400

    RULES = {"last_T": whole(2)}

    def simulate(self) -> FigureRows:
        """Return a row for each L: comparisons, violations by statement, and AFR's worst ratio to oracle-ideal."""
        lengths = range(1, self.last_T + 1)
        rows = FigureRows()
        for L in range(1, self.max_capacity + 1):
            row: Row = {"L": L, "paper_bound": bound(L), "sharper_bound": sharper_bound(L), "worst": 1.0, "at_T": 0}
            row |= dict.fromkeys(("comparisons", *VIOLATIONS), 0)
            both = (gaps_of(policy, L, lengths) for policy in ("afr", "drop-oldest"))
            for T, gaps, oldest_gaps in zip(lengths, *both, strict=True):
                afr, oldest, oracle = (extremes(g)[:T] for g in (gaps, oldest_gaps, best_gaps(L, T)))
                ideal = np.minimum(T + 1, np.arange(1, T + 1) * len(gaps))  # (L + 1) min((T + 1) / (L + 1), D)
                ratio = worst_ratio(gaps)
                doublings = math.log2((T + 1) / (L + 1)) if T >= L else 0.0
                row["comparisons"] += T
                row["above_oracle"] += int((afr > oracle).sum())
                row["oracle_above_ideal"] += int((oracle > ideal).sum())
                row["below_oldest"] += int((afr < oldest).sum())
                row["below_bound"] += int(not bound(L) < ratio <= 1 + ROUNDING)
                row["below_sharper"] += int(ratio < sharper_bound(L) * (1 - ROUNDING))
                row["uneven"] += int(not even_enough(gaps))
                row["unequal"] += int((gaps.min() == gaps.max()) != (doublings == int(doublings)))
                if ratio < row["worst"]:
                    row |= {"worst": ratio, "at_T": T}
            rows.append(row)
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        bounds = {"paper's bound": ("paper_bound", ".4f"), "sharper bound": ("sharper_bound", ".4f")}
        worst = {"worst of every V and T": ("worst", ".4f"), "at T": ("at_T", "")}
        return rows.listing({"L": ("L", "")} | bounds | worst, left=0)

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        counts = {name: int(rows.column(name).sum()) for name in VIOLATIONS}
        lemma, oracle = lemma_violations(), {T: kept_by_oracle(4, T) for T in (9, 14)}
        return {
            "lemma-1": lemma == 0,
            "lemma": lemma,
            "oracle": oracle == {9: [2, 4, 6, 8], 14: [3, 6, 9, 12]},
            "oracle_9": oracle[9],
            "oracle_14": oracle[14],
            "theorem-1": counts["above_oracle"] == counts["oracle_above_ideal"] == 0,
            "theorem-2": counts["below_bound"] == 0,
            "theorem-3": counts["below_oldest"] == 0,
            "sharper": counts["below_sharper"] == 0,
            "even": counts["uneven"] == 0,
            "equal": counts["unequal"] == 0,
            **counts,
            "comparisons": int(rows.column("comparisons").sum()),
            "pairs": self.max_capacity * self.last_T,
            "worst_8": rows.mean("worst", L=min(8, self.max_capacity)),
            "bound_8": bound(min(8, self.max_capacity)),
        }

    def draw(self, rows: FigureRows, figure: Any) -> None:
        axes = figure.add_subplot()
        looks = {
            "worst": ("o", "afr", "AFR, worst of every V and T"),
            "sharper_bound": ("-", "oracle-ideal", "sharper bound"),
            "paper_bound": ("--", "drop-oldest", "paper's bound"),
        }
        for name, (line, colour, label) in looks.items():
            axes.plot(rows.column("L"), rows.column(name), line, color=COLOURS[colour], markersize=4, label=label)
        finish(axes, f"Theorem 2: AFR at its worst, T = 1..{self.last_T}", xlim=(0, self.max_capacity + 1))
        axes.set(xlabel="L, messages", ylabel="AFR / oracle-ideal, information gained")
        axes.legend(loc="lower right", frameon=False)

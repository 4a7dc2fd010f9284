"""Theorems 1 to 3 of the AFR paper, checked on the simulator for every L, T and V of a grid.

Theorem 2 is the paper's: (H - 1) of AFR >= 2(sqrt 2 - 1) L / (L + 1) times oracle-ideal, for every T and every V that
keeps Eq. 3-6. A sharper bound, 2(sqrt((2L + 1) / (L + 1)) - 1), is checked as well. The wording of the other two is
ours, not the paper's; what is checked here is

1. oracle-ideal = (L + 1) V((T + 1) / (L + 1)) is an upper bound: of the integer oracle, and of AFR (Sec. III-C).
3. AFR's gaps: one pass of p merges gaps of r to gaps of 2r, so among the kept messages the largest gap is at most twice
   the smallest, and the gap at the edge, from the newest kept to message T + 1, is at most the smallest of these. All
   are equal, and AFR is oracle-ideal, exactly where T + 1 = (L + 1) 2^k.

"Every V" is checked exactly, not by sample. For gaps g that add up to T + 1 = (L + 1) m, the ratio
sum V(g) / ((L + 1) V(m)) is smallest for V(d) = min(1, d / m): with t = V(m), concavity gives V(g) >= t g / m for
g <= m, and V(g) >= t for g >= m. The worst ratio over all V is therefore sum min(1, g / m) / (L + 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym.oracle import interruption as oracle
from bufgym.reproduce.figure import COLOURS, Figure, finish, whole
from bufgym.reproduce.rows import Row, Rows, table
from bufgym.scenario import Interruption
from bufgym.sim import metrics

ROUNDING = 1e-12
"""Relative tolerance of every comparison below: sums of V are exact but for rounding."""

FALLS = (35, 36)
"""Two T, one after the other, at which H of AFR falls (L = 8, V(d) = 1 - 0.618^d)."""

VALUES: dict[str, Callable[[], Value]] = {
    **{f"exponential:{b}": partial(qoi.exponential, b) for b in (0.2, 0.618, 0.9, 0.99)},
    **{f"saturating:{D}": partial(qoi.saturating, D) for D in (1, 2.5, 7, 20, 61)},
    "tabulated: steep, then flat": partial(qoi.tabulated, [0, 1, 4, 12, 60], [0, 0.3, 0.6, 0.85, 1]),
    "tabulated: two slopes": partial(qoi.tabulated, [0, 3, 30], [0, 0.2, 0.9]),
}
"""The V that are tried one by one, beside the worst of all."""

VIOLATIONS = ("above_oracles", "below_paper_bound", "below_sharper_bound", "uneven", "equal_elsewhere")
"""Columns that count violations of a statement each."""


def bound(capacity: int) -> float:
    """Theorem 2 of the paper: AFR / oracle-ideal is at least this, for every T and V."""
    return 2 * (math.sqrt(2) - 1) * capacity / (capacity + 1)


def sharper_bound(capacity: int) -> float:
    """A bound above the paper's that holds as well; the two meet as L grows."""
    return 2 * (math.sqrt((2 * capacity + 1) / (capacity + 1)) - 1)


def gaps_of(policy: str, capacity: int, lengths: Sequence[int]) -> list[NDArray[np.int64]]:
    """The gaps between the messages received, 0 and T + 1 included, for each T; they don't depend on V."""
    interruption = Interruption(law="fixed", t_max=max(lengths))
    senders = sim.run(policies.get(policy), [interruption.episode(T) for T in lengths], capacity, interruption.value)
    return [np.diff(metrics.received(senders, i)["seq"]) for i in range(len(lengths))]


def worst_ratio(gaps: NDArray[np.int64]) -> float:
    """The smallest (H - 1) / oracle-ideal that these gaps have under any V that keeps Eq. 3-6 (see the module)."""
    mean = gaps.sum() / len(gaps)
    return float(np.minimum(1, gaps / mean).mean())


def even_enough(gaps: NDArray[np.int64]) -> bool:
    """Property 3: largest gap between kept messages <= 2 x the smallest, and the edge's gap <= the smallest."""
    inner, edge = gaps[:-1], gaps[-1]
    return bool(gaps.max() <= 2 * inner.min() and edge <= inner.min())


@dataclass(frozen=True)
class Reproduction(Figure):
    """Theorems 1-3 over L = 1..``max_capacity``, T = 1..``last_T`` and every V."""

    max_capacity: int = 32
    last_T: int = 400

    RULES = {"max_capacity": whole(), "last_T": whole(2)}

    def simulate(self) -> Rows:
        values = [make() for make in VALUES.values()]
        # V of each whole-numbered gap, so that a sum of V is a look-up.
        tables = np.array([[v(d) for d in range(self.last_T + 2)] for v in values])
        lengths = range(1, self.last_T + 1)
        rows = Rows()
        for L in range(1, self.max_capacity + 1):
            row: Row = {"L": L, "paper_bound": bound(L), "sharper_bound": sharper_bound(L)}
            row |= {"worst_any_v": 1.0, "at_T": 0, "worst_listed_v": 1.0, "listed_at_T": 0, "listed_v": ""}
            row |= dict.fromkeys(VIOLATIONS, 0)
            for T, gaps in zip(lengths, gaps_of("afr", L, lengths), strict=True):
                ideal = np.array([oracle.ideal(L, T, v) for v in values])
                integer = np.array([oracle.integer(L, T, v) for v in values])
                afr = tables[:, gaps].sum(axis=1)
                ratios, any_v = afr / ideal, worst_ratio(gaps)
                lowest = min(any_v, float(ratios.min()))
                doublings = math.log2((T + 1) / (L + 1)) if T >= L else 0.0
                row["above_oracles"] += int((integer > ideal * (1 + ROUNDING)).sum())
                row["above_oracles"] += int((afr > integer * (1 + ROUNDING)).sum())
                row["below_paper_bound"] += int(lowest < bound(L) * (1 - ROUNDING))
                row["below_sharper_bound"] += int(lowest < sharper_bound(L) * (1 - ROUNDING))
                row["uneven"] += int(not even_enough(gaps))
                row["equal_elsewhere"] += int((gaps.min() == gaps.max()) != (doublings == int(doublings)))
                if any_v < row["worst_any_v"]:
                    row |= {"worst_any_v": any_v, "at_T": T}
                if ratios.min() < row["worst_listed_v"]:
                    listed = list(VALUES)[int(ratios.argmin())]
                    row |= {"worst_listed_v": float(ratios.min()), "listed_at_T": T, "listed_v": listed}
            rows.append(row)
        return rows

    def tables(self, rows: Rows) -> list[str]:
        lines: list[list[str]] = [["  L", "paper", "sharper", "worst of any V (T)", "worst of those tried (T, V)"]]
        for row in rows:
            bounds = [f"{row['L']:3d}", f"{row['paper_bound']:.4f}", f"{row['sharper_bound']:.4f}"]
            any_v = "{worst_any_v:.4f} ({at_T:3d})".format(**row)
            lines.append([*bounds, any_v, "{worst_listed_v:.4f} ({listed_at_T:3d}, {listed_v})".format(**row)])
        return table(lines, left=5)

    def claims(self, rows: Rows) -> dict[str, Any]:
        v = qoi.exponential(0.618)
        counts = {name: int(rows.column(name).sum()) for name in VIOLATIONS}
        falls = [
            f"  T = {T}: H - 1 = {sum(v(float(g)) for g in gaps):.3f}, gaps {' '.join(map(str, gaps))}"
            for T, gaps in zip(FALLS, gaps_of("afr", 8, FALLS), strict=True)
        ]
        return {
            **{name: count == 0 for name, count in counts.items()},
            **{f"{name}_count": count for name, count in counts.items()},
            "values": len(VALUES),
            "cases": self.max_capacity * self.last_T * (len(VALUES) + 1),
            "falls": "\n\n".join(falls),
        }

    def draw(self, rows: Rows, figure: Any) -> None:
        axes = figure.add_subplot()
        looks = {
            "worst_listed_v": ("s", "other", "worst of the listed V"),
            "worst_any_v": ("o", "afr", "worst of any V"),
            "sharper_bound": ("-", "oracle-ideal", "sharper bound"),
            "paper_bound": ("--", "drop-oldest", "paper's bound"),
        }
        for name, (line, colour, label) in looks.items():
            axes.plot(rows.column("L"), rows.column(name), line, color=COLOURS[colour], markersize=4, label=label)
        finish(
            axes,
            f"Theorem 2: AFR at its worst, T = 1..{self.last_T}",
            xlim=(0, self.max_capacity + 1),
            xlabel="L, messages",
            ylabel="AFR / oracle-ideal, information gained",
        )
        axes.legend(loc="lower right", frameon=False)

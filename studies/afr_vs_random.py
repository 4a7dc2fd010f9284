"""AFR against Random's expectation over every concave V, a claim that the AFR paper does not prove.

See packages/papers/bufgym_papers/figures/README.md, "AFR against Random over every concave V".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.rows import Row
from bufgym_papers.figures.afr_theorems import extremes, gaps_of
from bufgym_papers.figures.figure import COLOURS, Figure, finish, whole
from bufgym_papers.figures.rows import FigureRows

ROUNDING = 1e-9  # Relative tolerance; the expectations are sums of some ten thousand products
COUNTEREXAMPLE = (1, 4, 2)  # L, T and D at which AFR falls short of Random's expectation
DRAWN_L, DRAWN_D = 8, (2, 5, 20)  # L and D of the picture's left panel


def expected_gaps(capacity: int, last_T: int) -> NDArray[np.float64]:
    """Return Random's expected number of gaps of each size at each T, float64[last_T + 1, last_T + 2]."""
    L, width = capacity, min(capacity, last_T) + 2
    counts = np.zeros((last_T + 1, last_T + 2))
    counts[0, 1] = 1
    between = np.arange(width)
    # alive[i, m]: message i and m messages after it are kept. Message 0 was sent before and is never dropped.
    alive = np.zeros((last_T + 1, width))
    alive[0, 0] = 1
    mortal = np.ones((last_T + 1, 1))
    mortal[0] = 0
    closing = {end: _all_dropped(L, end, last_T) for end in (1, 2)}
    for t in range(1, last_T + 1):
        # Message t is the pair's second: the messages kept between the two must go in the drops that follow.
        pairs = alive[:t]
        if t > L:
            pairs = pairs * np.maximum(0, 1 - (mortal[:t] + 1 + between) / (L + 1))
            pairs[:, :-1] += alive[:t, 1:] * between[1:] / (L + 1)
        last_drops = last_T - max(t, L)
        drops = np.maximum(0, np.arange(t, last_T + 1) - max(t, L))
        for first, end in ((slice(0, 1), 1), (slice(1, t), 2)):
            neighbours = pairs[first] @ closing[end][: max(0, last_drops) + 1].T[:, drops]
            for i, of_T in zip(range(t)[first], neighbours, strict=True):
                counts[t:, t - i] += of_T
        # Message t arrives behind each i.
        alive[:t, 1:] = alive[:t, :-1].copy()
        alive[:t, 0] = 0
        alive[t, 0] = 1
        if t > L:
            kept = alive[: t + 1] * np.maximum(0, 1 - (mortal[: t + 1] + between) / (L + 1))
            kept[:, :-1] += alive[: t + 1, 1:] * between[1:] / (L + 1)
            alive[: t + 1] = kept
        # The gap at the edge runs from i to message t + 1 with nothing between.
        counts[t, t + 1 - np.arange(t + 1)] += alive[: t + 1, 0]
    return counts


def _all_dropped(capacity: int, ends: int, last_T: int) -> NDArray[np.float64]:
    """Probability that after some drops all m messages between are gone and the ``ends`` are kept, [drops + 1, m]."""
    m = np.arange(min(capacity, last_T) + 2)
    gone = np.zeros((last_T + 1, len(m)))
    gone[0, 0] = 1
    for drops in range(1, last_T + 1):
        gone[drops] = gone[drops - 1] * np.maximum(0, 1 - (m + ends) / (capacity + 1))
        gone[drops, 1:] += gone[drops - 1, :-1] * m[1:] / (capacity + 1)
    return gone


def expected_extremes(capacity: int, last_T: int) -> NDArray[np.float64]:
    """Return Random's E[H - 1] at each T for V(d) = min(d, D), D = 1..last_T + 1; float64[last_T + 1, last_T + 1]."""
    counts = expected_gaps(capacity, last_T)
    at_least = counts[:, ::-1].cumsum(axis=1)[:, ::-1]  # gaps of each size and longer
    return np.asarray(at_least[:, 1:].cumsum(axis=1))


@dataclass(frozen=True)
class Reproduction(Figure):
    """AFR beside E[Random] for L = 1..``max_capacity``, T = L + 1..``last_T`` and V(d) = min(d, D), D = 1..T."""

    max_capacity: int = 32
    last_T: int = 160

    RULES = {"max_capacity": whole(DRAWN_L), "last_T": whole(COUNTEREXAMPLE[1])}
    SIZE_INCHES = (10.0, 4.4)

    def simulate(self) -> FigureRows:
        """Return a row for each L: how often E[Random] is above AFR, and the highest and lowest ratio of the two."""
        rows = FigureRows()
        for L in range(1, self.max_capacity + 1):
            random = expected_extremes(L, self.last_T)
            row: Row = {"L": L, "cases": 0, "violations": 0, "highest_ratio": 0.0, "at_T": 0, "at_D": 0}
            row["lowest_ratio"] = 1.0
            for T, gaps in enumerate(gaps_of("afr", L, range(1, self.last_T + 1)), start=1):
                if T > L:
                    afr, expected = extremes(gaps)[:T], random[T, :T]
                    row["cases"] += T
                    row["violations"] += int((expected > afr * (1 + ROUNDING)).sum())
                    # With D = 1, or D at least as long as every gap, both are equal whatever is dropped.
                    inner = slice(1, max(2, T - L))
                    ratios = expected[inner] / afr[inner]
                    row["lowest_ratio"] = min(row["lowest_ratio"], float(ratios.min()))
                    if ratios.max() > row["highest_ratio"]:
                        D = int(ratios.argmax()) + 2
                        row |= {"highest_ratio": float(ratios.max()), "at_T": T, "at_D": D}
            rows.append(row)
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        counts = {"L": ("L", ""), "cases": ("cases", ""), "E[Random] above AFR": ("violations", "")}
        highest = {"highest E[Random] / AFR": ("highest_ratio", ".6f"), "at T": ("at_T", ""), "at D": ("at_D", "")}
        return rows.listing(counts | highest, left=0)

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        L, T, D = COUNTEREXAMPLE
        (gaps,) = gaps_of("afr", L, [T])
        beyond_1 = FigureRows(row for row in rows if row["L"] > 1)
        violations = int(beyond_1.column("violations").sum())
        random = float(expected_extremes(L, T)[T, D - 1])
        afr = int(extremes(gaps)[D - 1])
        counter = {"counter_T": T, "counter_D": D, "counter_afr": afr, "counter_random": random}
        cases = {"violations": violations, "cases": int(beyond_1.column("cases").sum())}
        return {"grid": violations == 0 and not random > afr, "one": bool(random > afr), **cases, **counter}

    def draw(self, rows: FigureRows, figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        random = expected_extremes(DRAWN_L, self.last_T)
        lengths = range(1, self.last_T + 1)
        afr = [extremes(gaps) for gaps in gaps_of("afr", DRAWN_L, lengths)]
        for k, D in enumerate(DRAWN_D):
            style = {"linewidth": 1.3, "alpha": 1 - 0.25 * k}
            gained = [afr[T - 1][min(D, T + 1) - 1] / D for T in lengths]
            expected = [random[T, min(D, T + 1) - 1] / D for T in lengths]
            left.plot(lengths, gained, color=COLOURS["afr"], label=f"AFR, D = {D}", **style)
            left.plot(lengths, expected, color=COLOURS["random"], label=f"Random, expectation, D = {D}", **style)
        title = f"L = {DRAWN_L}, V(d) = min(1, d / D)"
        finish(left, title, xlabel="T, messages during the interruption", ylabel="information gained, H − 1")
        for which, marker, colour in (("highest", "^", "drop-oldest"), ("lowest", "v", "afr")):
            ratio, label = rows.column(f"{which}_ratio"), f"{which} of all T and D"
            right.plot(rows.column("L"), ratio, marker, color=COLOURS[colour], markersize=4.5, label=label)
        right.axhline(1, color=COLOURS["oracle"], linestyle="--", linewidth=1)
        finish(right, f"E[Random] / AFR, T ≤ {self.last_T}", xlabel="L, messages", ylabel="ratio of information gained")
        for axes in (left, right):
            axes.legend(loc="lower right", frameon=False, fontsize=8)

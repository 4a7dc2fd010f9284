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
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym import sim as sender
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym.oracle import interruption as oracle
from bufgym.reproduce.report import COLOURS, Report
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


def bound(capacity: int) -> float:
    """Theorem 2 of the paper: AFR / oracle-ideal is at least this, for every T and V."""
    return 2 * (math.sqrt(2) - 1) * capacity / (capacity + 1)


def sharper_bound(capacity: int) -> float:
    """A bound above the paper's that holds as well; the two meet as L grows."""
    return 2 * (math.sqrt((2 * capacity + 1) / (capacity + 1)) - 1)


def gaps_of(policy: str, capacity: int, lengths: Sequence[int]) -> list[NDArray[np.int64]]:
    """The gaps between the messages received, 0 and T + 1 included, for each T; they don't depend on V."""
    interruption = Interruption(law="fixed", t_max=max(lengths))
    done = sender.run(policies.get(policy), [interruption.episode(T) for T in lengths], capacity, interruption.value)
    return [np.diff(metrics.received(done, i)["seq"]) for i in range(len(lengths))]


def worst_ratio(gaps: NDArray[np.int64]) -> float:
    """The smallest (H - 1) / oracle-ideal that these gaps have under any V that keeps Eq. 3-6 (see the module)."""
    mean = gaps.sum() / len(gaps)
    return float(np.minimum(1, gaps / mean).mean())


def even_enough(gaps: NDArray[np.int64]) -> bool:
    """Property 3: largest gap between kept messages <= 2 x the smallest, and the edge's gap <= the smallest."""
    inner, edge = gaps[:-1], gaps[-1]
    return bool(gaps.max() <= 2 * inner.min() and edge <= inner.min())


def report(max_capacity: int = 32, last_T: int = 400) -> Report:
    """Theorems 1-3 over L = 1..``max_capacity``, T = 1..``last_T`` and every V."""
    if max_capacity < 1 or last_T < 2:
        raise BufgymError(f"max_capacity = {max_capacity}, last_T = {last_T}: need max_capacity >= 1 and last_T >= 2")
    values = [make() for make in VALUES.values()]
    # V of each whole-numbered gap, so that a sum of V is a look-up.
    tables = np.array([[v(d) for d in range(last_T + 2)] for v in values])
    lengths = range(1, last_T + 1)
    cases, violations = 0, {"1": 0, "2": 0, "2, sharper": 0, "3": 0, "3, equality": 0}
    rows: list[list[Any]] = []
    for L in range(1, max_capacity + 1):
        worst_any, at_any, worst_listed, at_listed = 1.0, 0, 1.0, (0, "")
        for T, gaps in zip(lengths, gaps_of("afr", L, lengths), strict=True):
            ideal = np.array([oracle.ideal(L, T, v) for v in values])
            integer = np.array([oracle.integer(L, T, v) for v in values])
            afr = tables[:, gaps].sum(axis=1)
            ratios, any_v = afr / ideal, worst_ratio(gaps)
            cases += len(values) + 1
            violations["1"] += int((integer > ideal * (1 + ROUNDING)).sum() + (afr > integer * (1 + ROUNDING)).sum())
            lowest = min(any_v, float(ratios.min()))
            violations["2"] += lowest < bound(L) * (1 - ROUNDING)
            violations["2, sharper"] += lowest < sharper_bound(L) * (1 - ROUNDING)
            violations["3"] += not even_enough(gaps)
            doublings = math.log2((T + 1) / (L + 1)) if T >= L else 0.0
            violations["3, equality"] += (gaps.min() == gaps.max()) != (doublings == int(doublings))
            if any_v < worst_any:
                worst_any, at_any = any_v, T
            if ratios.min() < worst_listed:
                worst_listed, at_listed = float(ratios.min()), (T, list(VALUES)[int(ratios.argmin())])
        rows.append([L, bound(L), sharper_bound(L), worst_any, at_any, worst_listed, *at_listed])

    v, before_after = qoi.exponential(0.618), gaps_of("afr", 8, FALLS)
    gained = [sum(v(float(g)) for g in gaps) for gaps in before_after]
    lines = [
        f"AFR paper, Theorems 1-3: L = 1..{max_capacity}, T = 1..{last_T}, {len(values)} V and the worst of all V; "
        f"{cases:,} cases.",
        "The wording of 1 and 3 is ours; 2 is the paper's bound 2(√2 - 1) L/(L + 1), and a sharper one.",
        "",
        f"1. AFR <= oracle <= oracle-ideal:                             {violations['1']} violations",
        f"2. AFR / oracle-ideal >= 2(√2 - 1) L/(L + 1):                 {violations['2']} violations",
        f"   AFR / oracle-ideal >= 2(√((2L + 1)/(L + 1)) - 1):          {violations['2, sharper']} violations",
        f"3. largest gap <= 2 x smallest, gap at the edge <= smallest:  {violations['3']} violations",
        f"   all gaps equal exactly where T <= L or T + 1 = (L + 1) 2^k: {violations['3, equality']} violations",
        "",
        "   L   paper  sharper  worst of any V (T)   worst of those tried (T, V)",
    ]
    for row in rows:
        lines.append("{:4d} {:7.4f} {:8.4f} {:11.4f} ({:3d}) {:16.4f} ({:3d}, {})".format(*row))
    lines += [
        "",
        "H is not monotone in T, here for L = 8 and V(d) = 1 - 0.618^d:",
        *(
            f"  T = {T}: H - 1 = {h:.3f}, gaps {' '.join(map(str, gaps))}"
            for T, h, gaps in zip(FALLS, gained, before_after, strict=True)
        ),
    ]

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        L = [row[0] for row in rows]
        axes.plot(L, [row[5] for row in rows], "s", color=COLOURS["other"], markersize=4, label="worst of the listed V")
        axes.plot(L, [row[3] for row in rows], "o", color=COLOURS["afr"], markersize=5, label="worst of any V")
        axes.plot(L, [row[2] for row in rows], "-", color=COLOURS["oracle-ideal"], label="sharper bound")
        axes.plot(L, [row[1] for row in rows], "--", color=COLOURS["drop-oldest"], label="paper's bound")
        axes.set(xlim=(0, max_capacity + 1), xlabel="L, messages", ylabel="AFR / oracle-ideal, information gained")
        axes.set_title(f"Theorem 2: AFR at its worst, T = 1..{last_T}", loc="left")
        axes.grid(alpha=0.25)
        axes.legend(loc="lower right", frameon=False)

    header = ["L", "paper_bound", "sharper_bound", "worst_any_v", "at_T", "worst_listed_v", "listed_at_T", "listed_v"]
    return Report("\n".join(lines), header, rows, draw)

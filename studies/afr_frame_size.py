"""Size of a frame in the AFR paper's evaluation, inferred from two numbers that the paper gives.

The paper does not state the size. It counts about 400 recalculations of ORB features in 794 frames, one with each
eviction by ORBBuf. It also says that AFR keeps 8 frames a second at L = 5 in the 21st and 23rd second, while the link
is under 500 KB/s. We count both for a sweep of sizes over the recorded link. Every run begins at the link's start, and
runs differ by the jitter of each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.benchmark.rows import Row
from bufgym.scenario import Uplink
from bufgym.scenario.afr_evaluation import FRAME_BYTES
from bufgym.scenario.numbered import draw
from bufgym.scenario.suites import CAPACITIES, RATE_HZ, time_value
from bufgym.utils.tables import aligned
from bufgym_papers.figures.afr_fig6 import LinkFigure
from bufgym_papers.figures.figure import COLOURS, finish
from bufgym_papers.figures.rows import FigureRows, listed

SECONDS = (21, 23)
PAPER_RECALCULATIONS, PAPER_HZ = 400, 8.0
NEAR = 0.05  # Recalculations within this fraction of the paper's, at every L, fit the paper's
WITHIN_HZ = 1.0  # A rate this near to the paper's 8 Hz counts as the same
JITTER = 0.1  # Largest delay of a frame, as a fraction of its period


@dataclass(frozen=True)
class Reproduction(LinkFigure):
    """Recalculations and frame rates for each size."""

    capacities: Sequence[int] = CAPACITIES
    runs: int = 10
    sweep_kb: Sequence[float] = (140, 150, 170, 180, 200, 230)  # further frame sizes, kB

    SIZE_INCHES = (9.0, 3.8)

    def simulate(self) -> FigureRows:
        """Return a row for each size, policy, L and run."""
        rows = FigureRows()
        for size_kb in sorted({self.size_bytes / 1000, *self.sweep_kb}):
            size: dict[str, Any] = {"size_bytes": round(1000 * size_kb), "size_cv": 0.0, "value": time_value()}
            stream: dict[str, Any] = {"rate_hz": RATE_HZ, "jitter": JITTER, "duration_s": self.frames / RATE_HZ}
            uplink = Uplink(traces=(self.link,), link_offset_s=(0.0, 0.0), **stream, **size)
            episodes = [draw(uplink, seed) for seed in range(self.runs)]
            names = ("afr", "afr-paper", "orbbuf", "drop-oldest")
            for (seed, episode), policy, L in product(enumerate(episodes), names, self.capacities):
                senders = sim.run(policies.get(policy), [episode], L, uplink.value)
                count = senders.batch.senders[0]["arrivals"]
                kept = np.asarray(senders.batch.log[0])[:count]["dropped_us"] == sim.NEVER
                arrival_s = episode.arrivals["arrival_us"][:count] / 1e6
                row: Row = {"size_kb": size_kb, "policy": policy, "L": L, "run": seed, "dropped": int((~kept).sum())}
                row["full"] = full(np.asarray(senders.batch.log[0])[:count], arrival_s, L)
                for s in SECONDS:
                    row[f"kept_in_second_{s}"] = int((kept & (s <= arrival_s) & (arrival_s < s + 1)).sum())
                rows.append(row)
        return rows

    def recalculations(self, rows: FigureRows, size_kb: float) -> tuple[float, float]:
        """Return the fewest and the most recalculations over L; each is a mean over runs."""
        counts = [rows.mean("dropped", size_kb=size_kb, policy="orbbuf", L=L) for L in self.capacities]
        return min(counts), max(counts)

    def rates_hz(self, rows: FigureRows, size_kb: float) -> list[float]:
        """Frames kept in each of the two seconds at the smallest L by `afr` and `afr-paper`, mean over runs."""
        shown = rows.where(size_kb=size_kb, L=min(self.capacities))
        return [shown.mean(f"kept_in_second_{s}", policy=p) for p in ("afr", "afr-paper") for s in SECONDS]

    def tables(self, rows: FigureRows) -> list[str]:
        heads = [f"{policy}, second {s}" for policy in ("afr", "afr-paper") for s in SECONDS]
        lines = [["kB", "recalculations", *heads]]
        for size_kb in rows.distinct("size_kb"):
            counts, rates = self.recalculations(rows, size_kb), self.rates_hz(rows, size_kb)
            lines.append([f"{size_kb:g}", "{:.0f}-{:.0f}".format(*counts), *(f"{hz:.1f}" for hz in rates)])
        title = "ORBBuf's evictions over all L; frames that AFR keeps of each second at the smallest L:"
        return [title, *aligned(lines)]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        sizes = rows.distinct("size_kb")
        counts = {kb: self.recalculations(rows, kb) for kb in sizes}
        rates = {kb: self.rates_hz(rows, kb) for kb in sizes}
        many = {kb: abs(np.array(c) / PAPER_RECALCULATIONS - 1).max() <= NEAR for kb, c in counts.items()}
        fast = {kb: abs(np.array(hz) - PAPER_HZ).max() <= WITHIN_HZ for kb, hz in rates.items()}
        main = self.size_bytes / 1000
        shares = [rows.mean("full", size_kb=main, policy="drop-oldest", L=L) for L in self.capacities]
        return {
            "kb": main,
            "fewest": counts[main][0],
            "most": counts[main][1],
            "near": 100 * NEAR,
            "counted_kb": listed([f"{kb:g}" for kb in sizes if many[kb]]),
            "rated_kb": listed([f"{kb:g}" for kb in sizes if fast[kb]]),
            "both_kb": listed([f"{kb:g}" for kb in sizes if many[kb] and fast[kb]]),
            "rates": ", ".join(f"{hz:.1f}" for hz in rates[main]),
            "least_L": min(self.capacities),
            "sizes": listed(self.capacities),
            "full_shares": listed([f"{share:.0%}" for share in shares]),
        }

    def draw(self, rows: FigureRows, figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        sizes = rows.distinct("size_kb")
        fewest, most = np.array([self.recalculations(rows, kb) for kb in sizes]).T
        left.fill_between(sizes, fewest, most, color=COLOURS["pink"], alpha=0.5, label="ORBBuf's evictions, all L")
        left.axhline(PAPER_RECALCULATIONS, color=COLOURS["oracle"], linestyle="--", label="paper, about 400")
        looks = [(policy, line, s) for policy, line in (("afr", "-"), ("afr-paper", "--")) for s in SECONDS]
        for (policy, line, s), hz in zip(looks, np.array([self.rates_hz(rows, kb) for kb in sizes]).T, strict=True):
            colour = COLOURS["afr" if s == SECONDS[0] else "drop-oldest"]
            right.plot(sizes, hz, line, marker="o", color=colour, label=f"{policy}, second {s}")
        right.axhline(PAPER_HZ, color=COLOURS["oracle"], linestyle=":", label="paper, 8 Hz")
        finish(left, "Recalculations in 794 frames", ylabel="evictions")
        finish(right, f"Frames kept, L = {min(self.capacities)}", ylabel="frames/s", ylim=(0, 12))
        for axes in (left, right):
            axes.axvline(FRAME_BYTES / 1000, color=COLOURS["other"], linewidth=1)
            axes.set_xlabel("size of a frame, kB")
            axes.legend(frameon=False, fontsize=8)


def full(log: NDArray[np.void], arrival_s: NDArray[np.float64], capacity: int) -> float:
    """Share of the time until the last arrival in which ``capacity`` messages are queued."""
    left_us = np.where(log["dropped_us"] == sim.NEVER, log["dequeued_us"], log["dropped_us"])
    left_s = np.where(left_us == sim.NEVER, np.inf, left_us / 1e6)
    at_s = np.concatenate([left_s, arrival_s])  # at one time those that leave come first
    change = np.repeat([-1, 1], len(arrival_s))
    order = np.argsort(at_s, kind="stable")
    lasts_s = np.diff(np.minimum(at_s[order], arrival_s[-1]))
    return float(lasts_s[np.cumsum(change[order])[:-1] >= capacity].sum() / (arrival_s[-1] - arrival_s[0]))

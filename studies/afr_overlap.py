"""Eq. 3-6 of the AFR paper tested on views of real frames: do the assumptions on V hold, and does it matter?

See packages/papers/PERCEPTION.md, "What a frame shows: overlap and coverage".
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.rows import Row
from bufgym_papers.figures.afr_theorems import gaps_of
from bufgym_papers.figures.figure import COLOURS, finish, legend_below
from bufgym_papers.figures.frame_runs import FrameFigure
from bufgym_papers.figures.rows import FigureRows

NOISE = 0.05  # Violation of a rule that still counts as keeping it, because depth has noise and edges
EVERY = 10  # Distance between the starts of interruptions, frames


@dataclass(frozen=True)
class Reproduction(FrameFigure):
    """Rate of violations of Eq. 5 and 6 at each distance, and the policies' gain by the measured V."""

    capacity: int = 8
    distances: Sequence[int] = (1, 2, 4, 8, 12, 18, 27, 40, 60, 90)
    """Distances d in messages; those above L are also the lengths T of interruptions."""
    motions: Sequence[float] = (0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5)  # distances d in fields of view

    SIZE_INCHES = (11.0, 3.8)

    def simulate(self) -> FigureRows:
        rows = FigureRows()
        for recording in self.recordings:
            seen, x = self.stage(recording).seen, self.x_of(recording)
            v = 1.0 - seen.astype(np.float64)
            number = np.arange(len(x), dtype=np.float64)
            for by, at, distances in (("frames", number, self.distances), ("motion", x, self.motions)):
                for d in distances:
                    if (rules := _rules(v, at, d)) is not None:
                        played = by == "frames" and self.capacity < d
                        gained = _gained(v, seen, self.capacity, int(d)) if played else _NOTHING
                        rows.append({"recording": recording, "by": by, "d": float(d)} | rules | gained)
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        lines: list[str] = []
        heads = ("mean V", "10 %", "90 %", "Eq. 5 broken", "Eq. 6 broken", "by")
        columns = {"d": ("d", "g")} | {head: (name, ".3f") for head, name in zip(heads, _RULES, strict=True)}
        for recording, by in rows.distinct("recording", "by"):
            shown = rows.where(recording=recording, by=by)
            unit = "frames" if by == "frames" else "fields of view"
            lines += [f"{recording}, d in {unit}:", *shown.listing(columns), ""]
        return lines[:-1]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        played = FigureRows(row for row in rows.where(by="frames") if row["behind"] is not None)
        facts: dict[str, Any] = {}
        for rule in ("broken_5", "broken_6"):
            by = ({b: rows.mean(rule, by=b, recording=r) for b in ("frames", "motion")} for r in self.recordings)
            facts[rule] = self.of_each(
                "{frames:.0%} of the cases by frames, {motion:.0%} by motion".format(**b) for b in by
            )
        facts["excess"] = float(rows.column("excess_6").max())
        facts["rising"] = bool((rows.column("broken_5") < NOISE).all())
        facts["concave"] = bool((rows.column("broken_6") < NOISE).all())
        broken = [f"{r['recording']} d = {r['d']:g} ({r['by']})" for r in rows if r["V_twice"] > 2 * r["V"]]
        facts |= {"mean_concave": not broken, "mean_breaks": ", ".join(broken) or "nowhere"}
        if played:
            behind = {r: played.mean("behind", recording=r) for r in played.distinct("recording")}
            facts["matters"] = max(behind.values()) <= NOISE
            facts["behind"] = "; ".join(f"{r} {share:.1%}" for r, share in behind.items())
            facts["of_best"] = "; ".join(
                f"{r} AFR {played.mean('afr_of_best', recording=r):.3f}, "
                f"Drop Oldest {played.mean('oldest_of_best', recording=r):.3f}"
                for r in behind
            )
        else:
            facts |= {"behind": "not played", "of_best": "not played"}
        return facts

    def draw(self, rows: FigureRows, figure: Any) -> None:
        colours = dict(zip(self.recordings, (COLOURS["afr"], COLOURS["drop-oldest"]), strict=False))
        left, middle, right = figure.subplots(1, 3)
        for recording, colour in colours.items():
            for axes, by in ((left, "frames"), (middle, "motion")):
                shown = rows.where(recording=recording, by=by)
                d = shown.column("d")
                axes.fill_between(d, shown.column("V_low"), shown.column("V_high"), color=colour, alpha=0.2)
                axes.plot(d, shown.column("V"), "o-", color=colour, markersize=4, label=recording)
            by_frames = rows.where(recording=recording, by="frames")
            played = FigureRows(row for row in by_frames if row["behind"] is not None)
            for name, line in (("afr", "-"), ("oldest", "--")):
                label = f"{recording}, {'AFR' if name == 'afr' else 'Drop Oldest'}"
                right.plot(played.column("d"), played.column(f"{name}_of_best"), line, color=colour, label=label)
        finish(left, "V by frames: mean, 10 to 90 %", xlabel="distance d, frames", ylim=(0, 1))
        left.set_ylabel("part that is new")
        finish(middle, "V by motion", xlabel="distance d, fields of view", ylim=(0, 1))
        finish(right, "H by the measured V", xlabel="interruption T, frames", ylabel="of the best in hindsight")
        right.legend(frameon=False, fontsize=8)
        legend_below(figure, 2, left)


_RULES = ("V", "V_low", "V_high", "broken_5", "broken_6", "excess_6")
_NOTHING: Row = {"behind": None, "afr_of_best": None, "oldest_of_best": None}


def _rules(v: NDArray[np.float64], at: NDArray[np.float64], d: float) -> Row | None:
    """Measure V at distance ``d`` from each frame and how often 2 d breaks a rule; None if no frame is so far.

    ``v`` float64[frames, frames] is V(i, j), and ``at`` float64[frames] the position of each frame, never falling.
    """
    once, twice = (np.searchsorted(at, at + distance - 1e-9) for distance in (d, 2 * d))
    i = np.flatnonzero(twice < len(at))
    if not len(i):
        return None
    near, far = v[i, once[i]], v[i, twice[i]]
    excess = far - 2 * near
    return {
        "V": float(near.mean()),
        "V_twice": float(far.mean()),
        "V_low": float(np.quantile(near, 0.1)),
        "V_high": float(np.quantile(near, 0.9)),
        "broken_5": float((far < near - NOISE).mean()),
        "broken_6": float((excess > NOISE).mean()),
        "excess_6": float(excess[excess > NOISE].mean()) if (excess > NOISE).any() else 0.0,
    }


def _gained(v: NDArray[np.float64], seen: NDArray[np.float32], L: int, T: int) -> Row:
    """Compare H of AFR and Drop Oldest with the best H by the measured V, over interruptions of T frames."""
    starts = np.arange(0, len(v) - T - 1, EVERY)
    if not len(starts):
        return _NOTHING
    kept = {name: np.append(0, np.cumsum(gaps_of(policy, L, [T])[0])) for name, policy in _POLICIES.items()}
    gained = {name: np.array([overlap_information(seen, i + rows) for i in starts]) for name, rows in kept.items()}
    best = np.array([1.0 + best_gain(v[i : i + T + 2, i : i + T + 2], L) for i in starts])
    return {
        "behind": float((gained["afr"] < gained["oldest"] - NOISE).mean()),
        "afr_of_best": float(gained["afr"].sum() / best.sum()),
        "oldest_of_best": float(gained["oldest"].sum() / best.sum()),
    }


_POLICIES = {"afr": "afr", "oldest": "drop-oldest"}


def best_gain(v: NDArray[np.float64], L: int) -> float:
    """Largest gain of at most ``L`` frames between the first and the last frame, by V(i, j) = ``v[i, j]``."""
    later = np.triu(np.ones(v.shape, np.bool_), 1)
    step = np.where(later, v, -np.inf)
    reached = step[0].copy()
    for _ in range(L):
        reached = np.maximum(reached, (reached[:, None] + step).max(axis=0))
    return float(reached[-1])


def overlap_information(seen: NDArray[np.float32], frames: Iterable[int]) -> float:
    """H of these frames by the measured V, 1 + the sum of V(before, frame) in order; 0 without frames."""
    kept = np.fromiter(frames, np.int64)
    if not len(kept):
        return 0.0
    return 1.0 + float((1.0 - seen[kept[:-1], kept[1:]].astype(np.float64)).sum())

"""How far H is from the best: regret, and the score between Drop Oldest and the clairvoyant."""

from __future__ import annotations

from typing import Any

import numpy as np

BASELINE = "drop-oldest"
"""The policy whose score is 0: what ROS does."""

TIE = 1e-9
"""Two H that differ by less, relative to their size, are equal: sums of the same gaps in another order."""


def regret(h: float, most: float) -> float:
    """1 - H / H of the clairvoyant; 0 where nothing could be delivered at all."""
    return 1 - h / most if most > 0 else 0.0


def normalised_score(h: Any, base: Any, best: Any) -> Any:
    """(sum H - sum H_baseline) / (sum H_clairvoyant - sum H_baseline), from the three sums; not clipped.

    0 is the baseline (Drop Oldest: what ROS does), 1 the clairvoyant; NaN where the baseline leaves nothing to gain.
    """
    gap = np.asarray(best, np.float64) - base
    return np.divide(h - base, gap, out=np.full_like(gap + h, np.nan), where=gap > TIE * np.abs(best))

"""Distance of H from the best: regret, and the score between Drop Oldest and the clairvoyant."""

from __future__ import annotations

from typing import Any

import numpy as np

BASELINE = "drop-oldest"
"""The policy of score 0: the drop rule of ROS."""

TIE = 1e-9
"""Relative difference up to which two H are equal: they sum the same gaps in another order."""


def regret(h: float, most: float) -> float:
    """1 - H / H of the clairvoyant; 0 if nothing could be delivered at all."""
    return 1 - h / most if most > 0 else 0.0


def normalised_score(h: Any, base: Any, best: Any) -> Any:
    """(sum H - sum H_baseline) / (sum H_clairvoyant - sum H_baseline), from the three sums; not clipped.

    0 is the baseline Drop Oldest, 1 the clairvoyant. NaN if the baseline leaves nothing to gain.
    """
    gap = np.asarray(best, np.float64) - base
    return np.divide(h - base, gap, out=np.full_like(gap + h, np.nan), where=gap > TIE * np.abs(best))

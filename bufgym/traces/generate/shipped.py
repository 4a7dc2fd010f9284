"""Which seeds and parameters of `lte.py` and `driving.py` are shipped; `studies.shipped` writes the files."""

from typing import Final

from bufgym.traces.generate.lte import LteMode

# Mode and mean in bytes/s of lte-synthetic-<seed>.csv. The means lie around the 6.9 MB/s of 30 frames of 230 kB a
# second: from a link that barely suits a robot to one where only breakdowns are a problem.
SHIPPED_LTE: Final[tuple[tuple[LteMode, float], ...]] = (
    *(("walk", 8e6), ("walk", 10e6), ("walk", 12e6)),
    *(("drive", 8e6), ("drive", 10e6), ("drive", 12e6)),
    *(("train", 9e6), ("train", 11e6)),
)
SHIPPED_SEEDS_OF_MOTION: Final = (0, 1)
SHIPPED_DURATION_S: Final = 300


def shipped_calls() -> dict[str, str]:
    """Name of each shipped file -> the call that generates it, with its seed."""
    links = {
        f"lte-synthetic-{seed}": f'synthetic_lte({seed}, {SHIPPED_DURATION_S}, {mean / 1e6:g}e6, "{mode}")'
        for seed, (mode, mean) in enumerate(SHIPPED_LTE)
    }
    motions = {f"drive-{seed}": f"drive_motion({seed}, {SHIPPED_DURATION_S})" for seed in SHIPPED_SEEDS_OF_MOTION}
    return motions | links

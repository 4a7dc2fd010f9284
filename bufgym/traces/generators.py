"""The traces that bufgym ships, made anew: `python -m bufgym.traces.generators traces/`.

The models are in `synthetic.py`; this file says which seeds and parameters are shipped.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

from bufgym.errors import BufgymError, TraceError, where
from bufgym.traces.files import StrPath
from bufgym.traces.motion import write_motion_csv
from bufgym.traces.synthetic import LteMode, drive_motion, outage, synthetic_lte
from bufgym.traces.writers import write_csv

__all__ = [
    "SHIPPED_LTE",
    "SHIPPED_SEEDS_OF_MOTION",
    "drive_motion",
    "outage",
    "shipped_calls",
    "synthetic_lte",
    "write_shipped",
]

# Mode and mean in bytes/s of lte-synthetic-<seed>.csv. The means lie around the 6.9 MB/s of 30 frames of 230
# kB a second: from a link that barely suits a robot to one that only its breakdowns trouble.
SHIPPED_LTE: Final[tuple[tuple[LteMode, float], ...]] = (
    ("walk", 8e6),
    ("walk", 10e6),
    ("walk", 12e6),
    ("drive", 8e6),
    ("drive", 10e6),
    ("drive", 12e6),
    ("train", 9e6),
    ("train", 11e6),
)
SHIPPED_SEEDS_OF_MOTION: Final = (0, 1)
SHIPPED_DURATION_S: Final = 300


def shipped_calls() -> dict[str, str]:
    """Name of each shipped file -> the call, with its seed, that makes it."""
    links = {
        f"lte-synthetic-{seed}": f'synthetic_lte({seed}, {SHIPPED_DURATION_S}, {mean / 1e6:g}e6, "{mode}")'
        for seed, (mode, mean) in enumerate(SHIPPED_LTE)
    }
    motions = {f"drive-{seed}": f"drive_motion({seed}, {SHIPPED_DURATION_S})" for seed in SHIPPED_SEEDS_OF_MOTION}
    return motions | links


def write_shipped(folder: StrPath) -> list[Path]:
    """Write the shipped traces and motion recordings into `folder`, made if need be; returns the files'
    paths.

    Raises:
        TraceError: the folder or a file cannot be written.
    """
    to = Path(folder)
    try:
        to.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TraceError(where(to, None, None, f"cannot be made: {error.strerror or error}")) from error
    written = []
    for seed, (mode, mean_bytes_per_s) in enumerate(SHIPPED_LTE):
        written.append(to / f"lte-synthetic-{seed}.csv")
        write_csv(synthetic_lte(seed, SHIPPED_DURATION_S, mean_bytes_per_s, mode), written[-1])
    for seed in SHIPPED_SEEDS_OF_MOTION:
        written.append(to / f"drive-{seed}.csv")
        write_motion_csv(drive_motion(seed, SHIPPED_DURATION_S), written[-1])
    return written


def main(arguments: list[str]) -> int:
    """Write the shipped files into the one folder given; the process's exit status."""
    if len(arguments) != 1 or arguments[0].startswith("-"):
        print("usage: python -m bufgym.traces.generators FOLDER", file=sys.stderr)
        return 2
    try:
        for path in write_shipped(arguments[0]):
            print(path)
    except BufgymError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

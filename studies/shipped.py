"""Generate the traces that bufgym ships: `python -m studies.shipped traces/`.

The models are in `bufgym/traces/generate/`; its `shipped.py` states which seeds and parameters are shipped.
"""

import sys
from pathlib import Path

from bufgym.traces import write_csv, write_motion_csv
from bufgym.traces.generate.driving import drive_motion
from bufgym.traces.generate.lte import synthetic_lte
from bufgym.traces.shipped import SHIPPED_DURATION_S, SHIPPED_LTE, SHIPPED_SEEDS_OF_MOTION


def main(folder: Path) -> None:
    """Write the shipped traces and motion recordings into `folder`."""
    for seed, (mode, mean_bytes_per_s) in enumerate(SHIPPED_LTE):
        trace = synthetic_lte(seed, SHIPPED_DURATION_S, mean_bytes_per_s, mode)
        write_csv(trace, folder / f"lte-synthetic-{seed}.csv")
    for seed in SHIPPED_SEEDS_OF_MOTION:
        write_motion_csv(drive_motion(seed, SHIPPED_DURATION_S), folder / f"drive-{seed}.csv")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

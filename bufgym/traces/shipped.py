"""The traces and motion recordings that come with bufgym, by name; `studies.shipped` generates their files."""

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.links import read_trace
from bufgym.traces.formats.motions import read_motion
from bufgym.traces.formats.tables import Columns
from bufgym.traces.generate.rules import steady
from bufgym.traces.motion import Motion
from bufgym.traces.trace import After, Holes, Trace
from bufgym.utils import files
from bufgym.utils.units import rate_of

if TYPE_CHECKING:
    from bufgym.traces.generate.lte import LteMode

# Mode and mean in bytes/s of lte-synthetic-<seed>.csv. The means lie around the 6.9 MB/s of 30 frames of 230 kB a
# second: from a link that barely suits a robot to one where only breakdowns are a problem.
SHIPPED_LTE: Final[tuple[tuple["LteMode", float], ...]] = (
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


def shipped() -> dict[str, Path]:
    """Name -> path of the shipped files: `lte-synthetic-0` .. `7` and the motions `drive-0`, `drive-1`.

    A wheel carries them inside the package; a checkout has them in its top-level `traces/`. Empty if neither exists.
    """
    return files.shipped("traces", "traces", "*.csv")


def load(
    name_or_path: StrPath,
    format: str | None = None,
    after: After = "loop",
    *,
    column: str | None = None,
    columns: Columns | None = None,
    holes: Holes = "hold",
) -> Trace:
    """A bandwidth trace by its shipped name, from a file, or of one rate, as in `20Mbit/s`.

    Args:
        name_or_path: a shipped name takes precedence, then a file, plain or gzip'd.
        format: of the file (docs/guide/recordings.md lists them); by default it is detected from the content.
        after: as in `Trace`.
        column: the one to read, where a format has several; see `read_trace`.
        columns: of any other table, which columns hold time and rate; without `format` and `column`.
        holes: in a stretch without samples "hold" the rate before it, send nothing ("zero"), or "refuse" the file.
    """
    rate = None if Path(name_or_path).exists() else rate_of(os.fspath(name_or_path))
    if rate is not None:
        return replace(steady(rate), name=os.fspath(name_or_path))
    return read_trace(
        _resolve(name_or_path, "; a steady link is as in 4Mbit/s"),
        format,
        after,
        column=column,
        columns=columns,
        holes=holes,
    )


def load_motion(name_or_path: StrPath) -> Motion:
    """A motion recording by its shipped name or from a file; trajectories are read with the default settings."""
    return read_motion(_resolve(name_or_path))


def _resolve(name_or_path: StrPath, also: str = "") -> StrPath:
    paths = shipped()
    if isinstance(name_or_path, str) and name_or_path in paths:
        return paths[name_or_path]
    if not Path(name_or_path).exists():
        names = ", ".join(paths) or "none found"
        raise fault(name_or_path, f"no such file, and no shipped trace (known: {names}){also}")
    return name_or_path

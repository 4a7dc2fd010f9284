"""Parameters of a fitted link, and the file that keeps them, one entry a way of moving.

`links.json` beside this module is what `bufgym trace fit` made of public recordings; it carries its command.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

from bufgym.errors import BufgymError, TraceError, where
from bufgym.traces.files import StrPath, write_text

LINKS: Final = Path(__file__).with_name("links.json")

# Where the law of the rates is tabled, and the same as numbers of standard deviations; -3 and 3 stand for the
# least and the greatest rate.
PROBABILITIES: Final = (0.0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
DEVIATIONS: Final = (-3.0, -2.326348, -1.644854, -1.281552, -0.67449, 0.0, 0.67449, 1.281552, 1.644854, 2.326348, 3.0)

# Quantiles 0, 1/4, 1/2, 3/4 and 1 of the seconds of an outage.
LOW_QUANTILES: Final = 5

# Seconds before and after an outage that are worse than others.
SHOULDER_S: Final = 5

_MAX_RATE: Final = 1e10
_MAX_FILE_BYTES: Final = 1 << 20


@dataclass(frozen=True)
class OutageParameters:
    """Seconds below a threshold, in runs: how far apart, how long, how bad.

    Attributes:
        spells: runs of such seconds that the numbers come from.
        short_gap_share: chance that the next one follows soon: outages come in clusters.
        short_gap_s, long_gap_s: mean time from one's end to the next one's start, each geometric, s.
        shoulder: mean rate within SHOULDER_S of an outage, relative to that of seconds farther off.
        length_tail, length_scale_s: a run goes on beyond k s with chance (1 + k / scale)**-tail.
        low_quantiles_bytes_per_s: 5 rates, from least to greatest, of the seconds inside.
        borrowed: whether lengths and rates come from all modes of the fit, for there are too few spells.
    """

    spells: int
    short_gap_share: float
    short_gap_s: float
    long_gap_s: float
    shoulder: float
    length_tail: float
    length_scale_s: float
    low_quantiles_bytes_per_s: tuple[float, ...]
    borrowed: bool = False

    def __post_init__(self) -> None:
        _within(self, "spells", 1, 1e9)
        _within(self, "short_gap_share", 0, 1)
        _within(self, "short_gap_s", 1, 1e7)
        _within(self, "long_gap_s", 1, 1e7)
        _within(self, "shoulder", 0, 1)
        _within(self, "length_tail", 0.1, 100)
        _within(self, "length_scale_s", 0.01, 1e4)
        _quantiles(self, "low_quantiles_bytes_per_s", LOW_QUANTILES)


@dataclass(frozen=True)
class LinkParameters:
    """A link in steps of 1 s; `markov.py` says how a trace is drawn from it.

    Attributes:
        recordings, seconds: what it was fitted to.
        quantiles_bytes_per_s: rates at `PROBABILITIES` among the seconds neither of outages nor beside them.
        place_share: part of the variance (of the normal scores of the rates) that stays for a whole trace.
        level_share: part that holds for a while, then is drawn anew.
        level_stay_s: how long that is in the mean, s.
        fast_memory: correlation from one second to the next of the part that is left, an AR(1) process.
        outages: None if there were none.
    """

    recordings: int
    seconds: int
    quantiles_bytes_per_s: tuple[float, ...]
    place_share: float
    level_share: float
    level_stay_s: float
    fast_memory: float
    outages: OutageParameters | None

    def __post_init__(self) -> None:
        _within(self, "recordings", 1, 1e9)
        _within(self, "seconds", 1, 1e9)
        _quantiles(self, "quantiles_bytes_per_s", len(PROBABILITIES))
        if not self.quantiles_bytes_per_s[0] > 0:
            raise BufgymError("quantiles_bytes_per_s must be above 0: a second outside outages carries something")
        _within(self, "place_share", 0, 1)
        _within(self, "level_share", 0, 1 - self.place_share + 1e-9)
        _within(self, "level_stay_s", 1, 1e7)
        _within(self, "fast_memory", 0, 0.999)


@functools.cache
def fitted_links() -> Mapping[str, LinkParameters]:
    """The links that come with bufgym, by way of moving (or, for WiFi, by place)."""
    return read_links(LINKS)


def read_links(path: StrPath) -> dict[str, LinkParameters]:
    """Parameters by mode, from a file that `bufgym trace fit` made.

    Raises:
        TraceError: the file cannot be read, is over 1 MiB, or a value breaks its rule.
    """
    try:
        with open(path, "rb") as file:
            raw = file.read(_MAX_FILE_BYTES + 1)
    except OSError as error:
        raise TraceError(where(path, None, None, f"cannot be read: {error.strerror or error}")) from error
    if len(raw) > _MAX_FILE_BYTES:
        raise TraceError(where(path, None, None, f"must be at most {_MAX_FILE_BYTES} bytes"))
    try:
        found = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise TraceError(where(path, None, None, f"must be JSON: {error}")) from error
    modes = found.get("modes") if isinstance(found, dict) else None
    if not isinstance(modes, dict) or not modes:
        raise TraceError(where(path, None, None, 'must be an object with "modes", as `bufgym trace fit` writes it'))
    made = {}
    for mode, entry in modes.items():
        try:
            made[mode] = _link(entry)
        except BufgymError as error:
            raise TraceError(where(path, None, None, f"mode {mode!r}: {error}")) from error
    return made


def write_links(links: Mapping[str, LinkParameters], path: StrPath, threshold_bytes_per_s: float, made_by: str) -> None:
    """Write parameters by mode; the same links give the same bytes.

    Args:
        threshold_bytes_per_s: below which a second counts as one of an outage.
        made_by: the command, to be kept with its result.
    """
    whole = {
        "about": "Links fitted to recordings, in steps of 1 s: see bufgym/traces/generate/markov.py. Rates in bytes/s.",
        "made_by": made_by,
        "outage_below_bytes_per_s": threshold_bytes_per_s,
        "probabilities_of_quantiles": PROBABILITIES,
        "modes": {mode: asdict(link) for mode, link in links.items()},
    }
    write_text(path, [_dumped(whole)])


def _dumped(whole: Mapping[str, Any]) -> str:
    """JSON with a line for each number, but rows of numbers on one."""
    text = json.dumps(whole, indent=2)
    for row in {m for part in text.split("[")[1:] for m in [part.split("]")[0]]}:
        text = text.replace(f"[{row}]", f"[{', '.join(cell.strip() for cell in row.split(','))}]")
    return text + "\n"


def _link(entry: object) -> LinkParameters:
    values = _values(entry, LinkParameters)
    if values.get("outages") is not None:
        values["outages"] = OutageParameters(**_values(values["outages"], OutageParameters))
    return LinkParameters(**values)


def _values(entry: object, kind: type[LinkParameters] | type[OutageParameters]) -> dict[str, Any]:
    """The entry's values, if it has just the fields of `kind`, rows as tuples."""
    names = {field.name for field in fields(kind)}
    if not isinstance(entry, dict) or set(entry) != names:
        raise BufgymError(f"must be an object with {', '.join(sorted(names))}")
    return {name: tuple(value) if isinstance(value, list) else value for name, value in entry.items()}


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _within(owner: object, name: str, least: float, most: float) -> None:
    value = getattr(owner, name)
    if not (_number(value) and least <= value <= most):
        raise BufgymError(f"{name} = {value!r}: must be a number from {least:g} to {most:g}")


def _quantiles(owner: object, name: str, count: int) -> None:
    row = getattr(owner, name)
    good = (
        isinstance(row, tuple) and len(row) == count and all(_number(rate) and 0 <= rate <= _MAX_RATE for rate in row)
    )
    if not good or list(row) != sorted(row):
        raise BufgymError(f"{name}: must be {count} rates from 0 to {_MAX_RATE:g} bytes/s that do not decrease")

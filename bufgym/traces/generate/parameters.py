"""Parameters of fitted links, and the file that holds them: one entry for each mode, that is, way of moving.

`links.json` and `uplinks.json` are what `bufgym trace fit` wrote for public recordings; each states its command.
"""

import functools
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Final, get_type_hints

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.logs import read_json
from bufgym.traces.formats.text import write_text
from bufgym.traces.generate.draws import checked, is_finite
from bufgym.utils.errors import BufgymError

LINKS: Final = Path(__file__).with_name("links.json")
UPLINKS: Final = Path(__file__).with_name("uplinks.json")

# Where the rates' distribution is tabulated, also in standard deviations; -3 and 3 are the least and greatest rate.
PROBABILITIES: Final = (0.0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
DEVIATIONS: Final = (-3.0, -2.326348, -1.644854, -1.281552, -0.67449, 0.0, 0.67449, 1.281552, 1.644854, 2.326348, 3.0)

# Quantiles 0, 1/4, 1/2, 3/4 and 1 of the seconds of an outage.
LOW_QUANTILES: Final = 5

# Seconds before and after an outage in which rates are lower.
SHOULDER_S: Final = 5

_MAX_RATE: Final = 1e10


def _check_ranges(parameters: object) -> None:
    """Check each field of a dataclass that is annotated with a range, as in `share: Annotated[float, (0, 1)]`."""
    for name, hint in get_type_hints(type(parameters), include_extras=True).items():
        for limits in getattr(hint, "__metadata__", ()):
            checked(name, getattr(parameters, name), *limits)


@dataclass(frozen=True)
class OutageParameters:
    """Outages: runs of seconds below a threshold."""

    spells: Annotated[int, (1, 1e9)]
    """Number of outages that the other numbers come from."""
    short_gap_share: Annotated[float, (0, 1)]
    """Chance that the next outage follows soon: outages come in clusters."""
    short_gap_s: Annotated[float, (1, 1e7)]
    """Mean time from one's end to the start of the next, if that follows soon; geometric, s."""
    long_gap_s: Annotated[float, (1, 1e7)]
    """The same for the others."""
    shoulder: Annotated[float, (0, 1)]
    """Mean rate within SHOULDER_S of an outage, relative to that of seconds farther away."""
    length_tail: Annotated[float, (0.1, 100)]
    """An outage lasts longer than k s with chance (1 + k / length_scale_s)**-length_tail."""
    length_scale_s: Annotated[float, (0.01, 1e4)]
    """See length_tail."""
    low_quantiles_bytes_per_s: tuple[float, ...]
    """5 rates, from least to greatest, of the seconds inside."""
    borrowed: bool = False
    """Whether lengths and rates come from all modes of the fit, because there are too few outages."""

    def __post_init__(self) -> None:
        _check_ranges(self)
        _check_quantiles(self, "low_quantiles_bytes_per_s", LOW_QUANTILES)


@dataclass(frozen=True)
class LinkParameters:
    """A link in steps of 1 s; `markov.py` says how a trace is drawn from it."""

    recordings: Annotated[int, (1, 1e9)]
    """Number of recordings that it was fitted to."""
    seconds: Annotated[int, (1, 1e9)]
    """Their total length, s."""
    quantiles_bytes_per_s: tuple[float, ...]
    """Rates at `PROBABILITIES` among the seconds that are neither in an outage nor beside one."""
    place_share: Annotated[float, (0, 1)]
    """Share of the variance (of the rates' normal scores) that stays the same for a whole trace."""
    level_share: float
    """Share that stays the same for a while, then is drawn again; at most 1 - place_share."""
    level_stay_s: Annotated[float, (1, 1e7)]
    """How long that is on average, s."""
    fast_memory: Annotated[float, (0, 0.999)]
    """Correlation from one second to the next of the remaining part, an AR(1) process."""
    outages: OutageParameters | None
    """None if there were none."""

    def __post_init__(self) -> None:
        _check_ranges(self)
        checked("level_share", self.level_share, 0, 1 - self.place_share + 1e-9)
        _check_quantiles(self, "quantiles_bytes_per_s", len(PROBABILITIES))
        if not self.quantiles_bytes_per_s[0] > 0:
            raise BufgymError("quantiles_bytes_per_s must be above 0: a second outside outages carries something")


@functools.cache
def fitted_links() -> Mapping[str, LinkParameters]:
    """Mode -> link, of the links that come with bufgym; for WiFi downlinks the mode is a place."""
    return read_links(LINKS) | read_links(UPLINKS)


def read_links(path: StrPath) -> dict[str, LinkParameters]:
    """Mode -> parameters, from a file that `bufgym trace fit` wrote.

    Raises:
        TraceError: the file cannot be read, or a value breaks its rule.
    """
    content = read_json(path)
    modes = content.get("modes") if isinstance(content, dict) else None
    if not isinstance(modes, dict) or not modes:
        raise fault(path, 'must be an object with "modes", as `bufgym trace fit` writes it')
    links = {}
    for mode, entry in modes.items():
        try:
            links[mode] = _link(entry)
        except BufgymError as error:
            raise fault(path, f"mode {mode!r}: {error}") from error
    return links


def write_links(links: Mapping[str, LinkParameters], path: StrPath, threshold_bytes_per_s: float, made_by: str) -> None:
    """Write the parameters of each mode; the same links give the same bytes.

    A second below the threshold counts as one of an outage. The file states ``made_by``, their command.
    """
    content = {
        "about": "Links fitted to recordings, in steps of 1 s: see bufgym/traces/generate/markov.py. Rates in bytes/s.",
        "made_by": made_by,
        "outage_below_bytes_per_s": threshold_bytes_per_s,
        "probabilities_of_quantiles": PROBABILITIES,
        "modes": {mode: asdict(link) for mode, link in links.items()},
    }
    # One line for each number, and one for each row of numbers.
    rows, text = re.compile(r"\[\s*([^]]*?)\s*\]"), json.dumps(content, indent=2)
    write_text(path, [rows.sub(lambda row: f"[{' '.join(row[1].split())}]", text), "\n"])


def _link(entry: object) -> LinkParameters:
    values = _values(entry, LinkParameters)
    if values.get("outages") is not None:
        values["outages"] = OutageParameters(**_values(values["outages"], OutageParameters))
    return LinkParameters(**values)


def _values(entry: object, kind: type[LinkParameters] | type[OutageParameters]) -> dict[str, Any]:
    """The entry's values, with rows as tuples; it must have exactly the fields of `kind`."""
    names = {field.name for field in fields(kind)}
    if not isinstance(entry, dict) or set(entry) != names:
        raise BufgymError(f"must be an object with {', '.join(sorted(names))}")
    return {name: tuple(value) if isinstance(value, list) else value for name, value in entry.items()}


def _check_quantiles(owner: object, name: str, count: int) -> None:
    rates = getattr(owner, name)
    is_row = isinstance(rates, tuple) and len(rates) == count
    if not (is_row and all(is_finite(r) and 0 <= r <= _MAX_RATE for r in rates) and list(rates) == sorted(rates)):
        raise BufgymError(f"{name}: must be {count} rates from 0 to {_MAX_RATE:g} bytes/s that do not decrease")

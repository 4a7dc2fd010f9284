"""``bufgym tune``: which setting of a policy does best on a suite's validation episodes.

Many a policy has a number in it that its source chose for another stream than a robot's. So that such a policy is not
judged by it alone, each meets a suite in two forms: at its source's numbers, and at those that a grid search finds on
the validation split. The test split is never looked at here.

A setting replaces the default only if its score is higher by more than chance: if the paired bootstrap interval of the
difference (see ``score``) lies above 0. What was found is kept in ``tuned.json``, which ``bufgym bench --suite`` reads.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from bufgym import __version__, policies
from bufgym.benchmark import table
from bufgym.benchmark.episodes import TIE
from bufgym.benchmark.rows import Row
from bufgym.benchmark.score import BASELINE, Interval, Scores, scores
from bufgym.benchmark.sweep import Plan, run_sweep
from bufgym.errors import BufgymError, where
from bufgym.files import replaced

FILE = Path(__file__).with_name("tuned.json")
"""What was found: {suite: {policy: {"setting", "score", "default_score", "split", "command", "bufgym", ...}}}."""


@dataclass(frozen=True)
class Grid:
    """Settings to try for one policy: every combination, and the default."""

    axes: Mapping[str, tuple[float, ...]]
    why: str
    """Where the range comes from."""


GRIDS = {
    "linear-alpha": Grid(
        {"alpha": (1, 1.15, 1.45, 1.6, 1.8, 2)},
        "1 is AFR, 1.302 has the best worst case; the larger, the more is kept of what came last",
    ),
    "even-reject": Grid(
        {"beta": (0.25, 0.5, 0.8, 1, 1.1, 1.2, 1.39, 1.5, 1.7, 2)},
        "around 1.2 to 1.39; at 1 the newcomer may be as near as L messages spread evenly, at 2 twice as far",
    ),
    "lifespan": Grid(
        {"lifespan_s": (0.1, 0.2, 1, 2, 5, 20)},
        "from three frames of 30/s to the length of an outage; without an end it is drop-oldest",
    ),
    "time-filter": Grid(
        {"separation_s": (0.05, 0.2, 0.3, 0.5, 1, 2)},
        "15 (one in two) to 0.5 frames/s of 30",
    ),
    "codel": Grid(
        {"target_ms": (5, 50, 200, 1000), "interval_ms": (100, 500, 2000)},
        "the RFC's 5 and 100 ms suit packets of 1500 bytes; 230 kB take tens of ms, a queue of 25 a second",
    ),
    "red": Grid(
        {"min_th": (0.05, 0.1, 0.25, 0.5), "max_th": (0.75, 1), "max_p": (0.1, 0.25, 0.5)},
        "the paper's max_p of at most 0.1 is for TCP senders, which slow down at a drop; thresholds are shares of L",
    ),
    "keyframe": Grid(
        {"step": (0.01, 0.02, 0.1, 0.2, 0.5, 2, 4, 8, 16)},
        "x is in fields of view (up to 0.5: half of the picture is new) or in frames (from 2 on)",
    ),
    "decimate": Grid(
        {"every": (1.25, 1.5, 2, 4, 6, 10, 20)},
        "24 to 1.5 frames/s of 30",
    ),
}
"""What is tuned. Towards one end some turn into drop-oldest (a long lifespan, a small step), where that is better."""

FIXED = {
    "ros-keep-last": "it stands for ROS 2 as delivered, with its default depth of 10",
    "foxglove-sdk": "it stands for the Foxglove SDK as delivered, with its default backlog of 1024 messages",
    "foxglove-backlog": "it stands for ros-foxglove-bridge as delivered, with its default limit of 10 MB",
}
"""What has parameters and is not tuned, and why."""


def settings(policy: str) -> list[str]:
    """The default of a policy of ``GRIDS``, as its plain name, then every other setting of its grid."""
    if policy in FIXED:
        raise BufgymError(f"policy {policy}: is not tuned: {FIXED[policy]}")
    if policy not in GRIDS:
        raise BufgymError(f"policy {policy!r}: no grid of settings; tuned are: {', '.join(GRIDS)}")
    default, axes = policies.get(policy), GRIDS[policy].axes
    specs = [policy]
    for numbers in product(*axes.values()):
        made = default.with_parameters(**dict(zip(axes, numbers, strict=True)))
        if made.parameters != default.parameters:
            specs.append(made.name)
    return specs


# --- the search ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tried:
    """One setting on the validation episodes."""

    spec: str
    score: Interval
    """Mean over the discriminative cells; NaN where none discriminative."""
    regret: Interval
    """Mean over the same cells, or over all where none discriminative."""
    gain: Interval
    """What it is better by than the default, paired: in score, or in regret where no cell discriminative."""


@dataclass(frozen=True)
class Choice:
    """What was tried for one policy."""

    policy: str
    tried: tuple[Tried, ...]
    """The default first."""

    @property
    def default(self) -> Tried:
        """The setting of the policy's source."""
        return self.tried[0]

    @property
    def best(self) -> Tried:
        """The first of those with the highest score (lowest regret, where no cell discriminative)."""
        return max(self.tried, key=lambda tried: tried.gain.value)

    @property
    def chosen(self) -> Tried:
        """The best, if it is better than the default by more than chance; else the default.

        The interval is that of one comparison: it knows nothing of how many settings were tried.
        """
        return self.best if self.best.gain.low > TIE else self.default


def tune(
    suite: str,
    names: Sequence[str] = (),
    *,
    split: str = "validation",
    data: str | None = None,
    seeds: int | None = None,
    jobs: int = -1,
) -> list[Choice]:
    """Try the grids of the policies (default: of all that have one) on a suite; one choice a policy.

    Args:
        suite: its name.
        names: policies of ``GRIDS``.
        split: "validation" or "train".
        data: folder of recordings, for suites that need one.
        seeds: episodes a trace; None: as many as the suite says.
        jobs: processes side by side; -1: one a core.

    Raises:
        BufgymError: for the split "test", a policy without a grid, and as for ``run_sweep``.
    """
    if split == "test":
        raise BufgymError("split = 'test': must be validation or train; parameters are never chosen on test episodes")
    specs = {name: settings(name) for name in dict.fromkeys(names or GRIDS)}
    plan = Plan(suite, tuple(spec for those in specs.values() for spec in those), split, seeds=seeds, data=data)
    with tempfile.TemporaryDirectory() as scratch:
        rows = run_sweep(plan, Path(scratch) / "run", jobs=jobs)
    return [compare(name, rows, those) for name, those in specs.items()]


def compare(policy: str, rows: Sequence[Row], specs: Sequence[str]) -> Choice:
    """Score the settings ``specs`` of one policy, the default first, from rows that hold theirs and the baseline's."""
    mine = [row for row in rows if row["policy"] in (*specs, BASELINE)]
    made = scores(mine)
    discriminative = any(cell.discriminative for cell in made.cells)
    gains = scores([*_only(mine, BASELINE), *_gains(mine, specs, discriminative)])
    tried = []
    for spec in specs:
        score, regret = _overall(made, spec)
        better, worse = _overall(gains, spec)
        gain = better if discriminative else Interval(-worse.value, -worse.high, -worse.low)
        tried.append(Tried(spec, score, regret, gain))
    return Choice(policy, tuple(tried))


def _gains(rows: Sequence[Row], specs: Sequence[str], discriminative: bool) -> list[Row]:
    """Rows whose score is that of a setting less that of the default, so that ``scores`` gives its paired interval.

    (H - H_baseline) / (H_clairvoyant - H_baseline) is linear in H: for H = H_baseline + H_setting - H_default it is the
    difference of the two scores. Likewise the regret for H = H_clairvoyant + H_setting - H_default.
    """
    base = _by_episode(rows, BASELINE)
    default = _by_episode(rows, specs[0])
    made = []
    for row in rows:
        if row["policy"] in specs:
            key = _episode(row)
            start = base[key] if discriminative else row["clairvoyant"]
            made.append({**row, "qoi": start + (row["qoi"] - default[key])})
    return made


def _only(rows: Sequence[Row], policy: str) -> list[Row]:
    return [row for row in rows if row["policy"] == policy]


def _by_episode(rows: Sequence[Row], policy: str) -> dict[tuple[Any, ...], float]:
    """H of one policy."""
    return {_episode(row): row["qoi"] for row in _only(rows, policy)}


def _episode(row: Row) -> tuple[Any, ...]:
    return tuple(row[key] for key in ("scenario", "capacity", "trace", "seed"))


def _overall(made: Scores, policy: str) -> tuple[Interval, Interval]:
    """(score, regret) of one policy.

    Where no cell is discriminative there is no standing: the regret is then the mean over all cells, and so are the
    bounds of its interval, which makes that one a little too wide.
    """
    standing = next(s for s in made.standings if s.policy == policy)
    if standing.cells:
        return standing.score, standing.regret
    each = [cell.regret for cell in made.cells if cell.policy == policy]
    return standing.score, Interval(*(math.fsum(part) / len(each) for part in zip(*each, strict=True)))


# --- what was found --------------------------------------------------------------------------------------------------


def plain(choices: Sequence[Choice]) -> str:
    """A table for each policy: every setting, best first."""
    out = []
    for choice in choices:
        lines = [["setting", "score", "regret", "better than the default", ""]]
        for tried in sorted(choice.tried, key=lambda tried: -tried.gain.value):
            gain = "-" if tried is choice.default else _written(tried.gain, 3)
            lines.append([tried.spec, _written(tried.score, 3), _written(tried.regret, 4), gain, _mark(choice, tried)])
        out += [f"{choice.policy}: {GRIDS[choice.policy].why}", *table.aligned(lines), ""]
    return "\n".join(out).rstrip()


def _mark(choice: Choice, tried: Tried) -> str:
    marks = ("default", choice.default), ("best", choice.best), ("chosen", choice.chosen)
    return ", ".join(mark for mark, marked in marks if marked is tried)


def _written(interval: Interval, digits: int) -> str:
    if math.isnan(interval.value):
        return "-"
    value, low, high = (f"{number:z.{digits}f}" for number in interval)
    return f"{value} [{low}, {high}]"


def write(suite: str, choices: Sequence[Choice], *, split: str, command: str) -> Path:
    """Put the choices into ``tuned.json``, in place of earlier ones for the same policies; the file's path."""
    found = read() if FILE.exists() else {}
    entries = found.setdefault(suite, {})
    for choice in choices:
        chosen, default = choice.chosen, choice.default
        entries[choice.policy] = {
            "setting": chosen.spec,
            "score": _kept(chosen.score.value),
            "default_score": _kept(default.score.value),
            "regret": _kept(chosen.regret.value),
            "default_regret": _kept(default.regret.value),
            "split": split,
            "command": command,
            "bufgym": __version__,
        }
    # Sorted, so that the file does not depend on the order of the runs.
    with replaced(FILE) as temporary:
        temporary.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return FILE


def _kept(number: float) -> float | None:
    return None if math.isnan(number) else round(number, 6) + 0.0  # no -0.0


def read() -> dict[str, dict[str, dict[str, Any]]]:
    """What ``tuned.json`` holds; an error that names the rule where it is broken."""
    try:
        found = json.loads(FILE.read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        raise BufgymError(f"{FILE}: must be UTF-8 text") from None
    except json.JSONDecodeError as error:
        raise BufgymError(where(FILE, error.lineno, None, f"must be JSON: {error.msg}")) from None
    if not isinstance(found, dict) or not all(isinstance(entries, dict) for entries in found.values()):
        raise BufgymError(f"{FILE}: must be a JSON object of suites, each an object of policies")
    for suite, entries in found.items():
        for policy, entry in entries.items():
            setting = entry.get("setting") if isinstance(entry, dict) else None
            if not isinstance(setting, str) or setting.partition(":")[0] != policy:
                rule = f"must be a setting of that policy, such as {policy}:parameter=1"
                raise BufgymError(where(FILE, None, setting or "", rule, field=f"{suite}.{policy}.setting"))
    return found


def tuned(suite: str) -> list[str]:
    """The settings found for this suite that differ from the policies' defaults."""
    found = []
    for policy, entry in read().get(suite, {}).items():
        try:
            setting, default = policies.get(entry["setting"]), policies.get(policy)
        except BufgymError as error:
            raise BufgymError(f"{FILE}: {suite}.{policy}: {error}") from None
        if setting.parameters != default.parameters:
            found.append(setting.name)
    return found


def specs(suite: str) -> list[str]:
    """Who meets a suite unless the caller says otherwise: every policy as its source has it, and the tuned variants.

    Suites are about one queue: policies made for topics are left out.
    """
    return [*policies.names(for_topics=False), *tuned(suite)]

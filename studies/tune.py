"""Search for a policy's best setting on a suite's validation episodes: ``python -m studies.tune SUITE``.

Many policies have a parameter that their source chose for another stream than a robot's. To judge them fairly, each
meets a suite twice: with its source's parameters, and with parameters from a grid search on the validation split. The
test split is never used here.

A rule of our own has too many parameters to cross. Each of them is tried alone around its default (``AROUND``), on the
train split: ``python -m studies.tune SUITE --policies target-gap,gap-price --split train`` finds the constants again.

A setting replaces the default only if its score is higher by more than chance. The test is that the paired bootstrap
interval of the difference, see ``score``, lies above 0. The choices are kept in ``tuned.json``, see ``tuned``.
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

from bufgym.benchmark import tuned
from bufgym.benchmark.bootstrap import Interval, written
from bufgym.benchmark.rows import Row
from bufgym.benchmark.score import Scores, scores
from bufgym.benchmark.sweep import Sweep, run_sweep
from bufgym.benchmark.table import decimal
from bufgym.cli.options import Seeds, Whole, command_line, policy_specs
from bufgym.oracle.measure import BASELINE, TIE
from bufgym.policies import get
from bufgym.scenario import suites
from bufgym.utils import __version__
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import write_text
from bufgym.utils.strict_json import read_object
from bufgym.utils.tables import Table
from studies.page import command


@dataclass(frozen=True)
class Grid:
    """Settings to try for one policy: every combination and the default."""

    axes: Mapping[str, tuple[float, ...]]  # values by parameter
    why: str  # source of the range


GRIDS = {
    "linear-alpha": Grid(
        {"alpha": (1, 1.15, 1.45, 1.6, 1.8, 2)},
        "1 is AFR, 1.302 has the best worst case; the larger, the more is kept of what came last",
    ),
    "even-reject": Grid(
        {"beta": (0.25, 0.5, 0.8, 1, 1.1, 1.2, 1.39, 1.5, 1.7, 2)},
        "around 1.2 to 1.39; at 1 the newcomer may be as near as L messages spread evenly, at 2 twice as far",
    ),
    "paced-motion-gap": Grid(
        {"pace": (0.1, 0.35, 0.5, 0.7, 0.85, 1), "discount": (0.05, 0.2, 0.35, 0.5)},
        "at pace 0.1 little is rejected, at 1 all nearer than an even spacing; at discount 0.05 all gaps count alike",
    ),
    "lifespan": Grid(
        {"lifespan_s": (0.1, 0.2, 1, 2, 5, 20)},
        "from three frames of 30/s to the length of an outage; without an end it is drop-oldest",
    ),
    "time-filter": Grid({"separation_s": (0.05, 0.2, 0.3, 0.5, 1, 2)}, "15 (one in two) to 0.5 frames/s of 30"),
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
    "decimate": Grid({"every": (1.25, 1.5, 2, 4, 6, 10, 20)}, "24 to 1.5 frames/s of 30"),
}
"""Grids of the tuned policies. At one end, such as a long lifespan or a small step, some become drop-oldest."""

_TARGET = ("horizon_s", "short", "long", "link_s", "paced", "pace_s")
AROUND = {"target-gap": (), "price-dp": (*_TARGET, "kappa", "tail", "price_threshold", "price_near"), "gap-price": ()}
"""Policies whose parameters are tried one at a time, and which; empty for all. ``price-dp`` has those of ``gap-price``
too and reads only these."""
FACTORS = (0.5, 0.7, 1.4, 2.0)
"""Factors on a default that is tried around."""

FIXED = {
    "gap-priority": "it is for several topics; python train.py tune finds its numbers",
    "ros-keep-last": "it stands for ROS 2 as delivered, with its default depth of 10",
    "foxglove-sdk": "it stands for the Foxglove SDK as delivered, with its default backlog of 1024 messages",
    "zenoh-drop": "it stands for Zenoh as delivered, with its default batches and waits",
    "ros2-best-effort": "it stands for Fast DDS over UDP; the link's queue is a fact, not a choice",
    "ros2-reliable-udp": "it stands for Fast DDS over UDP; the link's queue is a fact, not a choice",
    "foxglove-backlog": "it stands for ros-foxglove-bridge as delivered, with its default limit of 10 MB",
}
"""Policies that have parameters and are not tuned, with the reason."""


def settings(policy: str) -> list[str]:
    """List a policy's default as its plain name, then every other setting of its grid or around its default."""
    if policy in FIXED:
        raise BufgymError(f"policy {policy}: is not tuned: {FIXED[policy]}")
    if policy not in GRIDS and policy not in AROUND:
        raise BufgymError(f"policy {policy!r}: no grid of settings; tuned are: {', '.join((*GRIDS, *AROUND))}")
    default = get(policy)
    changes: list[dict[str, float]]
    if policy in GRIDS:
        axes = GRIDS[policy].axes
        changes = [dict(zip(axes, numbers, strict=True)) for numbers in product(*axes.values())]
    else:
        names = AROUND[policy] or tuple(default.parameters)
        numbers = {name: default.parameters[name] for name in names if default.parameters[name] > 0}  # 0 has no factors
        changes = [{name: float(f"{factor * n:.3g}")} for name, n in numbers.items() for factor in FACTORS]
    made = [default.with_parameters(**change) for change in changes]
    return [policy, *(setting.name for setting in made if setting.parameters != default.parameters)]


@dataclass(frozen=True)
class Tried:
    """One setting on the validation episodes."""

    spec: str  # setting as ``bufgym.policies.get`` takes it
    score: Interval  # mean over the discriminative cells; NaN where there is none
    regret: Interval  # mean over the same cells, or over all where none is discriminative
    gain: Interval  # paired gain over the default in score, or in regret if no cell is discriminative


@dataclass(frozen=True)
class Choice:
    """Settings tried for one policy."""

    policy: str  # its plain name
    tried: tuple[Tried, ...]  # settings with their results, the default first

    @property
    def default(self) -> Tried:
        """The setting of the policy's source."""
        return self.tried[0]

    @property
    def best(self) -> Tried:
        """First setting with the highest score, or with the lowest regret if no cell is discriminative."""
        return max(self.tried, key=lambda tried: tried.gain.value)

    @property
    def chosen(self) -> Tried:
        """Best setting if it beats the default by more than chance, otherwise the default.

        The interval is for a single comparison and does not account for the number of settings tried.
        """
        return self.best if self.best.gain.low > TIE else self.default


def tune(
    suite: str,
    names: Sequence[str] = (),
    *,
    split: str = "validation",
    data: str | None = None,
    seeds: int | None = None,
    jobs: int | None = None,
) -> list[Choice]:
    """Try the settings of policies, by default of all in ``GRIDS``, on a suite; return a choice for each.

    Args:
        suite: its name.
        names: policies of ``GRIDS`` and ``AROUND``.
        split: "validation" or "train".
        data: folder of recordings, for suites that need one.
        seeds: episodes on each trace; None for the suite's own number.
        jobs: see ``run_sweep``.

    Raises:
        BufgymError: the split is "test", a policy has no grid, or as for ``run_sweep``.
    """
    if split == "test":
        raise BufgymError("split = 'test': must be validation or train; parameters are never chosen on test episodes")
    if suites.get(suite).kind != "queue":
        raise BufgymError(f"suite {suite}: only policies of one queue are tuned")
    specs = {name: settings(name) for name in dict.fromkeys(names or GRIDS)}
    sweep = Sweep(suite, tuple(spec for those in specs.values() for spec in those), split, seeds=seeds, data=data)
    with tempfile.TemporaryDirectory() as scratch:
        rows = run_sweep(sweep, Path(scratch) / "run", jobs=jobs)
    return [compare(name, rows, those) for name, those in specs.items()]


def compare(policy: str, rows: Sequence[Row], specs: Sequence[str]) -> Choice:
    """Score the settings ``specs`` of one policy, the default first; ``rows`` also hold the baseline."""
    rows = [row for row in rows if row["policy"] in (*specs, BASELINE)]
    scored = scores(rows)
    discriminative = scored.counted > 0
    gains = scores(_gains(rows, specs, discriminative))
    tried = []
    for spec in specs:
        score, regret = _overall(scored, spec)
        better, worse = _overall(gains, spec)
        gain = better if discriminative else Interval(-worse.value, -worse.high, -worse.low)
        tried.append(Tried(spec, score, regret, gain))
    return Choice(policy, tuple(tried))


def _gains(rows: Sequence[Row], specs: Sequence[str], discriminative: bool) -> list[Row]:
    """Make rows whose score is a setting's score less the default's, so that ``scores`` gives the paired interval.

    The score (H - H_baseline) / (H_clairvoyant - H_baseline) is linear in H, so H = H_baseline + H_setting - H_default
    gives the difference of the two scores. Likewise H = H_clairvoyant + H_setting - H_default gives the difference of
    the regrets. The baseline's own rows come first, unchanged.
    """
    h = {(row["policy"], *_episode(row)): row["qoi"] for row in rows}
    gains = [row for row in rows if row["policy"] == BASELINE]
    for row in rows:
        if row["policy"] in specs:
            start = h[BASELINE, *_episode(row)] if discriminative else row["clairvoyant"]
            gains.append({**row, "qoi": start + (row["qoi"] - h[specs[0], *_episode(row)])})
    return gains


def _episode(row: Row) -> tuple[Any, ...]:
    return tuple(row[key] for key in ("scenario", "capacity", "trace", "seed"))


def _overall(scored: Scores, policy: str) -> tuple[Interval, Interval]:
    """Score and regret of one policy.

    Without discriminative cells there is no standing. The regret and its bounds are then means over all cells, which
    makes the interval a little too wide.
    """
    standing = next(s for s in scored.standings if s.policy == policy)
    if scored.counted:
        return standing["score"], standing["regret"]
    regrets = [cell.regret for cell in scored.cells if cell.policy == policy]
    return standing["score"], Interval(*(math.fsum(part) / len(regrets) for part in zip(*regrets, strict=True)))


def plain(choices: Sequence[Choice]) -> str:
    """Write a table for each policy with every setting, best first."""

    def text(interval: Interval, digits: int) -> str:
        return " ".join(filter(None, written(interval, lambda number: decimal(number, digits))))

    out = []
    for choice in choices:
        lines = []
        for tried in sorted(choice.tried, key=lambda tried: -tried.gain.value):
            gain = "–" if tried is choice.default else text(tried.gain, 3)
            marks = ("default", choice.default), ("best", choice.best), ("chosen", choice.chosen)
            mark = ", ".join(mark for mark, marked in marks if marked is tried)
            lines.append([tried.spec, text(tried.score, 3), text(tried.regret, 4), gain, mark])
        head = ["setting", "score", "regret", "better than the default", ""]
        grid = GRIDS.get(choice.policy)
        why = grid.why if grid else f"one parameter at a time, times {', '.join(f'{factor:g}' for factor in FACTORS)}"
        out += [f"{choice.policy}: {why}", Table(head, [("", lines)]).plain(), ""]
    return "\n".join(out).rstrip()


def keep(suite: str, choices: Sequence[Choice], *, split: str, again: str) -> Path:
    """Write the choices to ``tuned.json``, replacing earlier ones for the same policies; return its path."""
    suites = read_object(tuned.FILE) if tuned.FILE.exists() else {}
    for choice in choices:
        suites.setdefault(suite, {})[choice.policy] = {
            "setting": choice.chosen.spec,
            "score": _rounded(choice.chosen.score.value),
            "default_score": _rounded(choice.default.score.value),
            "regret": _rounded(choice.chosen.regret.value),
            "default_regret": _rounded(choice.default.regret.value),
            "split": split,
            "command": again,
            "bufgym": __version__,
        }
    # Sorted, so that the file does not depend on the order of the runs.
    return write_text(tuned.FILE, json.dumps(suites, indent=1, sort_keys=True) + "\n")


def _rounded(number: float) -> float | None:
    return None if math.isnan(number) else round(number, 6) + 0.0  # no -0.0


def main(
    suite: str,
    /,
    *,
    policies: list[str] | None = None,
    split: str = "validation",
    data: str | None = None,
    seeds: Seeds | None = None,
    jobs: Whole | None = None,
    write: bool = False,
) -> None:
    """Choose the policies' parameters on a suite's validation episodes.

    Args:
        suite: Which ('bufgym list suites').
        policies: Plain names (default: all that have a grid of settings).
        split: validation or train; test is refused.
        data: Folder of recordings, for suites over real links.
        seeds: Episodes on each trace (default: the suite's).
        jobs: Processes side by side (default: one a core).
        write: Keep the choices for bufgym bench --suite.
    """
    choices = tune(suite, policy_specs(policies), split=split, data=data, seeds=seeds, jobs=jobs)
    print(plain(choices))
    if write:
        # Another machine has its own folder of recordings.
        again = command_line(
            f"python -m studies.tune {suite}",
            policies=tuple(policies or ()) or None,
            split=None if split == "validation" else split,
            seeds=seeds,
            data=data and "DIR",
            write=True,
        )
        print(f"\nwrote {keep(suite, choices, split=split, again=again)}")


if __name__ == "__main__":
    command(main)

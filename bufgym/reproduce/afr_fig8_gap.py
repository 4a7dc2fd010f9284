"""Fig. 8 of the AFR paper, by a stand-in for tracking: how often a run has a motion gap too long to track across.

The paper runs visual tracking on the frames received and counts the runs that lose it. Here a run fails if, between two
messages received one after the other, the camera moved on by more than ``threshold`` fields of view. At 0.5 half of the
last view is gone: matching has half of its points left, at the image's far side. At 0.25 ORB-SLAM2 would already want a
new keyframe of an RGB-D camera (NeedNewKeyFrame: under 75 % of the reference keyframe's points tracked). Where tracking
really breaks depends on scene, blur and matcher, hence three thresholds, and one that knows none of it: the threshold
at which Drop Oldest fails in half of the runs, as it does in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bufgym.errors import BufgymError
from bufgym.reproduce.afr_evaluation import (
    CAMERAS,
    PAPER_CEILING,
    PAPER_FRAMES,
    PAPER_RUNS,
    STYLES,
    Row,
    Setting,
    about,
    column,
    load_cameras,
    load_link,
    runs_of,
    settings,
    share_carried,
    streamed,
)
from bufgym.reproduce.report import Report
from bufgym.scenario.suites import CAPACITIES, RATE_HZ, SIZE_BYTES
from bufgym.traces import Trace

MORE_RUNS = 100
"""Ten runs tell 0 from 50 %, not 0 from 10 %; simulated ones are cheap."""
IDLE = 10.0
"""Percent of the runs: where Drop Oldest and Random fail less often, AFR cannot be told from them."""


def report(
    data: Path | None = None,
    trace: str | None = None,
    motion: Sequence[str] = CAMERAS,
    threshold: float = 0.5,
    others: Sequence[float] = (0.25, 0.75),
    frames: int = PAPER_FRAMES,
    size_bytes: int = SIZE_BYTES,
    size_cv: float = 0.0,
    capacities: Sequence[int] = CAPACITIES,
    runs: int = PAPER_RUNS,
    more_runs: int = MORE_RUNS,
    ceiling_bytes_per_s: float | None = PAPER_CEILING,
) -> Report:
    """Failure rates of each policy at each L, over each link and camera.

    Args:
        data: folder of recordings, with belgium_4g/csv/report_car_0002.csv and tum_rgbd/*.groundtruth.txt.gz.
        trace: another trace in place of car_0002, a shipped name or a file.
        motion: TUM RGB-D sequences in ``data``, shipped motions or files; the figure shows the first.
        threshold: motion gap above which a run fails, fields of view.
        others: further thresholds, to see what hangs on it.
        size_cv: coefficient of variation of the frames' sizes.
        more_runs: runs of the second count, of which the first ``runs`` are the first.
        ceiling_bytes_per_s: a second link is scaled to this best second; None: the recorded link alone.
    """
    thresholds = sorted({threshold, *others})
    if not thresholds[0] > 0:
        raise BufgymError(f"threshold = {thresholds[0]}: must be above 0 fields of view")
    if not 1 <= runs <= more_runs:
        raise BufgymError(f"runs = {runs}, more_runs = {more_runs}: need 1 <= runs <= more_runs")
    link = load_link(trace, data)
    cameras = load_cameras(motion, data)
    shown = settings(
        link,
        cameras,
        timed=False,
        frames=frames,
        size_bytes=size_bytes,
        size_cv=size_cv,
        ceiling_bytes_per_s=ceiling_bytes_per_s,
    )
    results = [(setting, runs_of(setting, capacities, more_runs, bound=False)) for setting in shown]

    lines = [
        "AFR paper, Fig. 8, by a stand-in for tracking: a run fails if the camera moves on by more than "
        f"{threshold:g} fields of view",
        "between two messages received one after the other.",
        *about(link, frames, size_bytes, size_cv, runs),
        f"Failures in % of {runs} runs at each L; then of {more_runs} runs over all L, at each threshold.",
    ]
    for setting, rows in results:
        lines += ["", *_table(setting, rows, capacities, runs, threshold, thresholds)]
    lines += ["", *_claims(results, capacities, runs, more_runs, threshold)]
    lines += [
        "",
        f"No failure in {runs} runs still allows a rate of {1 - 0.05 ** (1 / runs):.0%} (95 % confidence); "
        f"in {more_runs}, of {1 - 0.05 ** (1 / more_runs):.0%}.",
        *_order(results, thresholds),
        "",
        "Why ours may differ: no image is matched here and nothing relocalises; how fast the camera moves decides who",
        "fails, as the threshold and the link do. The link carries, of the demand,",
        *_slowest(link, frames, size_bytes, shown),
    ]

    def draw(figure: Any) -> None:
        first = [(setting, rows) for setting, rows in results if setting.camera == cameras[0].name]
        grid = figure.subplots(len(first), len(thresholds), squeeze=False, sharex=True, sharey=True)
        for line, (setting, rows) in zip(grid, first, strict=True):
            for axes, limit in zip(line, thresholds, strict=True):
                _rates(axes, rows, capacities, limit, runs)
                axes.set_title(f"link {setting.link}, threshold {limit:g}", loc="left", fontsize=9)
            line[0].set_ylabel("runs that fail, %")
        for axes in grid[-1]:
            axes.set_xlabel("queue size L")
        figure.suptitle(f"{cameras[0].name}: marks {runs} runs, lines {more_runs} runs", fontsize=10)
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)

    header = ["link_scale", "camera", "L", "policy", "run", "longest_gap_views", "longest_gap_s"]
    table = [
        [
            repr(s.scale),
            s.camera,
            r["capacity"],
            r["policy"],
            r["seed"],
            repr(r["longest_gap"]),
            repr(r["longest_gap_s"]),
        ]
        for s, rows in results
        for r in rows
    ]
    size = (3.6 * len(thresholds) + 0.6, 2.6 * (len(results) // len(cameras)) + 1.0)
    return Report("\n".join(lines), header, table, draw, size)


def failures(rows: Sequence[Row], policy: str, threshold: float, capacity: int | None = None) -> float:
    """Part of the policy's runs whose longest motion gap exceeds the threshold."""
    return float((column(rows, "longest_gap", policy, capacity) > threshold).mean())


def _first(rows: Sequence[Row], runs: int) -> list[Row]:
    return [row for row in rows if row["seed"] < runs]


def _table(
    setting: Setting,
    rows: Sequence[Row],
    capacities: Sequence[int],
    runs: int,
    threshold: float,
    thresholds: Sequence[float],
) -> list[str]:
    lines = [
        f"{setting.label}",
        f"  {'L':15}"
        + "".join(f"{L:>6}" for L in capacities)
        + "   |"
        + "".join(f"{f'> {t:g}':>8}" for t in thresholds),
    ]
    for policy in STYLES:
        ten = "".join(f"{100 * failures(_first(rows, runs), policy, threshold, L):6.0f}" for L in capacities)
        many = "".join(f"{100 * failures(rows, policy, limit):8.1f}" for limit in thresholds)
        lines.append(f"  {policy:15}{ten}   |{many}")
    half = float(np.median(column(rows, "longest_gap", "drop-oldest")))
    matched = ", ".join(f"{p} {100 * failures(rows, p, half):.1f} %" for p in STYLES if p != "drop-oldest")
    return [*lines, f"  At {half:.2f} Drop Oldest fails in half of the runs, and {matched}"]


def _claims(
    results: Sequence[tuple[Setting, Sequence[Row]]],
    capacities: Sequence[int],
    runs: int,
    more_runs: int,
    threshold: float,
) -> list[str]:
    """The paper's three statements for each setting; the larger number of runs decides."""
    lines = [
        f"The paper's statements at threshold {threshold:g}, {runs} runs ({more_runs} in brackets; these decide):",
        f"  {'':33}{'Drop Oldest, Random fail':>32}{'AFR, worst L':>22}{'AFR, L > 10':>22}",
        f"  {'paper, % of the runs':33}{'about 40 to 60 ':>32}{'under 10 ':>22}{'never ':>22}",
    ]

    def worst(rows: Sequence[Row], above: int) -> float:
        return max((100 * failures(rows, "afr", threshold, L) for L in capacities if above < L), default=0.0)

    for setting, rows in results:
        ten = _first(rows, runs)
        few, many = (
            [100 * failures(some, policy, threshold) for policy in ("drop-oldest", "random")] for some in (ten, rows)
        )
        # Where nobody loses track, that AFR does not is no merit of its own.
        tells = max(many) >= IDLE
        others = f"{few[0]:.0f}, {few[1]:.0f} ({many[0]:.0f}, {many[1]:.0f})"
        cells = [f"{others} {_word(all(40 <= rate <= 60 for rate in many))}"]
        for above, most in ((0, 10.0), (10, 0.0)):
            rate = worst(rows, above)
            word = _word(rate < most or rate == most == 0) if tells else "no test"
            cells.append(f"{worst(ten, above):.0f} ({rate:.0f}) {word}")
        lines.append(f"  {setting.label:33}{cells[0]:>32}{cells[1]:>22}{cells[2]:>22}")
    return [
        *lines,
        f"Drop Oldest and Random over all L. No test: both fail in under {IDLE:g} %, which leaves AFR nothing to mend.",
    ]


def _order(results: Sequence[tuple[Setting, Sequence[Row]]], thresholds: Sequence[float]) -> list[str]:
    """Whether AFR fails least of the paper's simple policies whatever the threshold."""
    compared = [
        failures(rows, "afr", limit) <= min(failures(rows, other, limit) for other in ("drop-oldest", "random"))
        for _, rows in results
        for limit in thresholds
    ]
    return [
        f"AFR fails no more often than Drop Oldest and Random in {sum(compared)} of {len(compared)} pairs of setting "
        "and threshold."
    ]


def _slowest(link: Trace, frames: int, size_bytes: int, shown: Sequence[Setting]) -> list[str]:
    """What each link carries of the demand, on average and in its slowest second."""
    slowest = float(streamed(link, frames)[1].min()) / (RATE_HZ * size_bytes)
    return [
        f"- {name}: {share_carried(link, frames, size_bytes, scale):.0%}, in the slowest second {slowest * scale:.0%}"
        for name, scale in dict.fromkeys((setting.link, setting.scale) for setting in shown)
    ]


def _word(holds: bool) -> str:
    return "  holds" if holds else "DIFFERS"


def _rates(axes: Any, rows: Sequence[Row], capacities: Sequence[int], threshold: float, runs: int) -> None:
    """Failure rates against L: a mark for the first ``runs``, moved aside to be seen, and a line for all runs."""
    at = np.arange(len(capacities))
    for k, (policy, (label, colour, marker)) in enumerate(STYLES.items()):
        aside = at + 0.09 * (k - (len(STYLES) - 1) / 2)
        ten = [100 * failures(_first(rows, runs), policy, threshold, L) for L in capacities]
        axes.plot(aside, ten, marker, color=colour, markersize=5, label=label)
        axes.plot(at, [100 * failures(rows, policy, threshold, L) for L in capacities], color=colour, linewidth=1)
    axes.set_xticks(at, [str(L) for L in capacities])
    axes.set_ylim(-4, 104)
    axes.grid(alpha=0.25)

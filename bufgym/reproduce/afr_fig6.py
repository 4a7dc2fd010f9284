"""Fig. 6 of the AFR paper: the bandwidth of the Belgium 4G log car_0002 against what the camera demands.

Samples are numbered from 0, as the paper counts seconds. 230 kB a frame are our reading of "about 200 kB" of depth and
a low-quality JPEG.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bufgym.errors import BufgymError
from bufgym.reproduce.afr_evaluation import PAPER_CEILING, PAPER_FRAMES, load_link, share_carried, streamed
from bufgym.reproduce.report import COLOURS, Report
from bufgym.scenario.suites import RATE_HZ, SIZE_BYTES

PAPER_LOW = (21, 23)
"""The seconds under 500 KB/s that the paper names, counted from 0."""
LOW = 500e3
"""Bytes/s."""
NEAR = 0.1
"""A ceiling within so much of the paper's "about 15 MB/s" counts as the same."""


def report(
    data: Path | None = None,
    trace: str | None = None,
    frames: int = PAPER_FRAMES,
    size_bytes: int = SIZE_BYTES,
    show_s: float = 60.0,
) -> Report:
    """Fig. 6 for ``frames`` frames of ``size_bytes``; the figure shows the first ``show_s`` seconds and the whole.

    Args:
        data: folder of recordings, with belgium_4g/csv/report_car_0002.csv.
        trace: another trace in its place, a shipped name or a file.
    """
    if size_bytes < 1 or not show_s > 0:
        raise BufgymError(f"size_bytes = {size_bytes}, show_s = {show_s}: must be above 0")
    link = load_link(trace, data)
    lengths_us, rates = link.samples()
    ends_s = np.cumsum(lengths_us) / 1e6
    starts_s = ends_s - lengths_us / 1e6
    n = len(streamed(link, frames)[1])
    stream_s, demand = frames / RATE_HZ, RATE_HZ * size_bytes
    low = np.flatnonzero(rates < LOW)
    low_streamed = tuple(int(k) for k in low[low < n])
    best, best_of_all = float(rates[:n].max()), float(rates.max())

    table = [
        (
            "seconds under 500 KB/s",
            " and ".join(map(str, PAPER_LOW)),
            _numbers(low_streamed),
            low_streamed == PAPER_LOW,
        ),
        (
            "ceiling of the link, MB/s",
            f"about {PAPER_CEILING / 1e6:g}",
            f"{best / 1e6:.2f} ({best_of_all / 1e6:.2f} in all {link.duration_us / 1e6:.0f} s)",
            abs(best / PAPER_CEILING - 1) <= NEAR or abs(best_of_all / PAPER_CEILING - 1) <= NEAR,
        ),
    ]
    lines = [
        f"AFR paper, Fig. 6: bandwidth of {link.name} while {frames} frames come at {RATE_HZ:g} Hz ({stream_s:.1f} s).",
        "",
        f"{'':27} {'paper':10} ours",
        *(f"{what:27} {paper:10} {ours}: {'as there' if same else 'DIFFERS'}" for what, paper, ours, same in table),
        f"{'demand, MB/s':27} {'-':10} {demand / 1e6:.2f} ({RATE_HZ:g} x {size_bytes / 1000:g} kB)",
        f"{'seconds under the demand':27} {'-':10} {int((rates[:n] < demand).sum())} of {n}",
        f"{'carried of the demand':27} {'-':10} {share_carried(link, frames, size_bytes):.0%}",
        "",
        *(
            f"Second {k}: {rates[k] / 1e3:.1f} KB/s, from {starts_s[k]:.2f} to {ends_s[k]:.2f} s of the trace."
            for k in low_streamed
        ),
        f"{len(low)} of all {len(rates)} seconds lie under 500 KB/s: {_numbers(low)}.",
    ]
    if not table[1][3]:
        lines.append(
            f"The ceiling differs by a factor of {PAPER_CEILING / best:.2f} in the stream, "
            f"{PAPER_CEILING / best_of_all:.2f} in the whole trace; we do not know why.\n"
            "afr-fig7-qoi and afr-fig8-gap run both links: as recorded, and scaled to the paper's ceiling."
        )
    if (rates[:n] < demand).all():
        lines.append(
            "As recorded, the link never carries the demand during the stream: a lasting overload, not an interruption."
        )

    def draw(figure: Any) -> None:
        near, whole = figure.subplots(2, 1, height_ratios=[2, 1])
        for axes, until_s in ((near, min(show_s, ends_s[-1])), (whole, ends_s[-1])):
            axes.stairs(
                rates / 1e6, np.append(starts_s, ends_s[-1]), color=COLOURS["afr"], linewidth=1.2, label=link.name
            )
            axes.axhline(
                demand / 1e6, color=COLOURS["drop-oldest"], linewidth=1.4, label=f"demand {demand / 1e6:g} MB/s"
            )
            axes.axhline(
                PAPER_CEILING / 1e6, color=COLOURS["oracle"], linestyle=":", label="ceiling in the paper, about 15 MB/s"
            )
            axes.axvspan(0, stream_s, color=COLOURS["other"], alpha=0.13, linewidth=0, label="stream")
            for k in low[starts_s[low] < until_s]:
                axes.axvspan(starts_s[k], ends_s[k], color=COLOURS["drop-oldest"], alpha=0.35, linewidth=0)
            top = max(PAPER_CEILING, best_of_all, demand) / 1e6
            axes.set(xlim=(0, until_s), ylim=(0, 1.06 * top), ylabel="MB/s")
            axes.grid(alpha=0.25)
        for k in low_streamed:
            left = k == low_streamed[0]
            near.annotate(
                f"second {k}\n{rates[k] / 1e3:.0f} KB/s",
                (starts_s[k] if left else ends_s[k], demand / 1e6),
                (-3 if left else 3, 8),
                textcoords="offset points",
                ha="right" if left else "left",
                fontsize=8,
            )
        near.axvspan(-2, -1, color=COLOURS["drop-oldest"], alpha=0.35, linewidth=0, label="under 500 KB/s")
        near.set_title(f"{link.name}: the first {min(show_s, ends_s[-1]):.0f} s, and all of it", loc="left")
        whole.set_xlabel("time since the trace's start, s")
        figure.legend(*near.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)

    header = ["second", "start_s", "end_s", "bytes_per_s", "under_500KBps", "streamed"]
    rows = [
        [k, f"{starts_s[k]:.6f}", f"{ends_s[k]:.6f}", repr(float(rates[k])), bool(rates[k] < LOW), k < n]
        for k in range(len(rates))
    ]
    return Report("\n".join(lines), header, rows, draw, (7.5, 5.2))


def _numbers(seconds: Any) -> str:
    return ", ".join(str(int(k)) for k in seconds) or "none"

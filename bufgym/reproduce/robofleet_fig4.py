"""Fig. 4 of the Robofleet paper: how soon latency is back to nominal after a dropout.

A sender's nominal latency is the median of what arrived before the dropout. Its recovery time runs from the link's
return to the receipt of the first message from which on every message received has at most ``factor`` times that; a
sender whose last message is still later never recovers.

The paper leaves open how long the dropout was, what was sent, how fast the link was, and whether native ROS was similar
to Robofleet or to rosbridge. So the length and the link are swept, for one topic of each kind, at the rates that the
paper's Fig. 6 and 7 have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from bufgym.errors import BufgymError
from bufgym.reproduce.report import COLOURS, Report
from bufgym.reproduce.robofleet_evaluation import (
    MBIT,
    POINTS,
    QUEUE_SIZE,
    RIVALS,
    ROUND_TRIP_MS,
    Row,
    Sent,
    all_above_0,
    at_least_0,
    columns,
    mean_of,
    meet,
    stream,
    style,
    whole,
)
from bufgym.scenario.checks import above_0
from bufgym.traces import Trace

SENDERS = ("robofleet", "rosbridge", "ros-native")
RATES_HZ = {"PointCloud2": 5.0, "CompressedImage": 2.0, "LaserScan": 10.0}
PAPER_RATIO = 5.0
ABOUT = (4.0, 6.0)
"""What we let pass as "about 5 times"."""
BEFORE_S = 10.0
WATCHED = 12.0
"""After the link's return we watch for so many dropouts, and for ``LEAST_WATCHED_S`` at least."""
LEAST_WATCHED_S = 30.0


def report(
    dropouts_s: Sequence[float] = (1, 2, 5, 10, 20, 30),
    links_mbit_per_s: Sequence[float] = (12, 25, 50, 100),
    kinds: Sequence[str] = tuple(RATES_HZ),
    factor: float = 2.0,
    round_trip_ms: float = ROUND_TRIP_MS,
    silence_s: float = 0.0,
    queue_size: int = QUEUE_SIZE,
    points: int = POINTS,
    runs: int = 5,
    shown_s: float | None = None,
) -> Report:
    """Fig. 4 for these lengths of the dropout and these links; the figure shows the fastest link.

    Args:
        kinds: of messages, one topic each time.
        factor: latency within so many times nominal counts as nominal.
        round_trip_ms: half of it to the server, the whole from a message's crossing to its pong.
        silence_s: how long nothing is sent yet although the link is back, as TCP may be between two retransmissions.
        queue_size: of native ROS, messages.
        points: of a cloud, 16 bytes each.
        runs: differ by arrival jitter and by when within a period the link drops out.
        shown_s: which dropout the left panel shows; by default the one nearest to 10 s.
    """
    all_above_0("dropouts_s", dropouts_s)
    all_above_0("links_mbit_per_s", links_mbit_per_s)
    for name, given in (("round_trip_ms", round_trip_ms), ("silence_s", silence_s)):
        at_least_0(name, given)
    for name, number in (("runs", runs), ("queue_size", queue_size)):
        whole(name, number)
    if not kinds or isinstance(kinds, str) or not set(kinds) <= set(RATES_HZ):
        raise BufgymError(f"kinds = {kinds!r}: must be some of {', '.join(RATES_HZ)}")
    above_0("factor", factor)
    if factor <= 1:
        raise BufgymError(f"factor = {factor!r}: must be above 1")
    shown = min(dropouts_s, key=lambda s: abs(s - 10)) if shown_s is None else shown_s
    if shown not in dropouts_s:
        raise BufgymError(f"shown_s = {shown!r}: must be one of dropouts_s")
    rows: list[Row] = []
    seen: dict[str, tuple[float, Sent]] = {}
    for kind in kinds:
        for mbit in links_mbit_per_s:
            for dropout in dropouts_s:
                for seed in range(runs):
                    away_s = BEFORE_S + float(np.random.default_rng(seed).random()) / RATES_HZ[kind]
                    watch_s = max(LEAST_WATCHED_S, WATCHED * (dropout + silence_s))
                    outage_s = dropout + silence_s
                    link = Trace.steps([(away_s, mbit * MBIT), (outage_s, 0), (watch_s, mbit * MBIT)], after="hold")
                    for name in SENDERS:
                        sent = meet(
                            name,
                            (stream(kind, RATES_HZ[kind], points=points),),
                            link,
                            away_s + outage_s + watch_s,
                            seed,
                            round_trip_ms=round_trip_ms,
                            queue_size=queue_size,
                        )
                        took_s = recovery_s(sent, away_s, away_s + dropout, factor)
                        key = {"message": kind, "link_mbit_per_s": mbit, "dropout_s": dropout, "run": seed}
                        rows.append({**key, "sender": name, "recovery_s": took_s})
                        if (kind, mbit, dropout, seed) == (kinds[0], max(links_mbit_per_s), shown, 0):
                            seen[name] = (away_s + dropout, sent)

    cells = {
        (kind, mbit, dropout): tuple(
            mean_of(rows, "recovery_s", message=kind, link_mbit_per_s=mbit, dropout_s=dropout, sender=name)
            for name in SENDERS
        )
        for kind in kinds
        for mbit in links_mbit_per_s
        for dropout in dropouts_s
    }
    text = [
        f"Robofleet paper, Fig. 4: recovery after a dropout, until latency stays within {factor:g} times nominal; mean "
        f"of {runs} runs.",
        f"n_T = 1, round trip {round_trip_ms:g} ms, native ROS with a queue of {queue_size}, the socket silent for "
        f"{silence_s:g} s after the link's return.",
        "",
        *_table(cells, points),
        f"inf: not back to nominal within {WATCHED:g} times the dropout after it. 5x at: between the nearest lengths.",
        "",
        *_claims(cells, queue_size),
    ]

    def draw(figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        _draw_latency(left, seen, shown, f"{kinds[0]}, {max(links_mbit_per_s):g} Mbit/s, dropout of {shown:g} s")
        _draw_ratios(right, cells)
        left.legend(loc="upper left", frameon=False)
        figure.legend(*right.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)

    return Report("\n".join(text), *columns(rows), draw, (11.0, 4.8))


def recovery_s(sent: Sent, away_s: float, back_s: float, factor: float) -> float:
    """From the link's return at ``back_s`` until latency stays within ``factor`` times nominal; inf if it never does.

    Nominal: the median of what was received before ``away_s``, when the link went away.
    """
    got = sent.got
    latency_s = got.latency_s
    before = got.received_s <= away_s
    if not before.any():
        raise BufgymError("nothing was received before the dropout: no latency to call nominal")
    late = np.flatnonzero(latency_s > factor * np.median(latency_s[before]))
    late = late[got.received_s[late] > away_s]
    if len(late) == 0:
        return 0.0
    if late[-1] + 1 == len(got):
        return math.inf
    return max(0.0, float(got.received_s[late[-1] + 1]) - back_s)


Cells = dict[tuple[str, float, float], tuple[float, ...]]
"""(kind, Mbit/s, dropout in s) -> recovery of each of ``SENDERS``, s."""


def ratio(cell: Sequence[float]) -> float:
    """Rosbridge's recovery to Robofleet's."""
    return cell[1] / cell[0] if cell[0] > 0 and math.isfinite(cell[0]) else math.nan


def length_for(dropouts_s: Sequence[float], ratios: Sequence[float], wanted: float = PAPER_RATIO) -> str:
    """The dropout for which the ratio is ``wanted``, by a line between the two lengths around it."""
    known = sorted((d, r) for d, r in zip(dropouts_s, ratios, strict=True) if math.isfinite(r))
    for (d, r), (e, q) in pairwise(known):
        if r <= wanted <= q:
            return f"{d + (e - d) * (wanted - r) / (q - r) if q > r else d:.3g} s"
    if not known:
        return "none"
    return f"< {known[0][0]:g} s" if known[0][1] > wanted else f"> {known[-1][0]:g} s"


def _groups(cells: Cells) -> dict[tuple[str, float], dict[float, tuple[float, ...]]]:
    """The cells by kind and link."""
    made: dict[tuple[str, float], dict[float, tuple[float, ...]]] = {}
    for (kind, mbit, dropout), cell in cells.items():
        made.setdefault((kind, mbit), {})[dropout] = cell
    return made


def _table(cells: Cells, points: int) -> list[str]:
    groups = _groups(cells)
    dropouts = list(next(iter(groups.values())))
    lines = [
        f"{'':26}{'rosbridge':>10}{'recovery, s, from to':^28}  rosbridge's recovery to Robofleet's, dropout of",
        f"{'':26}{'load':>10}{'Robofleet':>14}{'native ROS':>14}  "
        + "".join(f"{f'{d:g} s':>8}" for d in dropouts)
        + f"{'5x at':>10}",
    ]
    for (kind, mbit), found in groups.items():
        json = stream(kind, RATES_HZ[kind], points=points).encodings["json"]
        load = json * RATES_HZ[kind] / (mbit * MBIT)
        ratios = [ratio(cell) for cell in found.values()]
        own, native = ([cell[k] for cell in found.values()] for k in (0, 2))
        lines.append(
            f"{kind:15}{mbit:4g} Mbit/s{load:10.0%}  {min(own):>6.3f} {max(own):<6.3f} {min(native):>6.3f} "
            f"{max(native):<6.3f} " + "".join(f"{r:8.1f}" for r in ratios) + f"{length_for(dropouts, ratios):>10}"
        )
    return lines


def _claims(cells: Cells, queue_size: int) -> list[str]:
    ratios = {key: ratio(cell) for key, cell in cells.items()}
    about = [key for key, r in ratios.items() if ABOUT[0] <= r <= ABOUT[1]]
    less = sum(r < ABOUT[0] for r in ratios.values())
    known = [cell for cell in cells.values() if min(cell) > 0 and math.isfinite(cell[0])]
    nearer = sum(abs(math.log(cell[2] / cell[0])) < abs(math.log(cell[1] / cell[2])) for cell in known)
    return [
        f"Paper: Robofleet is back about {PAPER_RATIO:g} times sooner than rosbridge. Here sooner in "
        f"{sum(r > 1 for r in ratios.values())} of {len(cells)} cells;",
        f"about {PAPER_RATIO:g} times ({ABOUT[0]:g} to {ABOUT[1]:g}) in {len(about)}, less in {less}, more in "
        f"{len(cells) - less - len(about)}. About {PAPER_RATIO:g} times:",
        *(
            f"  {kind} at {mbit:g} Mbit/s: {', '.join(f'{d:g} s' for k, m, d in about if (k, m) == (kind, mbit))}"
            for kind, mbit in dict.fromkeys((kind, mbit) for kind, mbit, _ in about)
        ),
        "Rosbridge must first send what it queued: about dropout x load / (1 - load). Robofleet's slot holds one "
        "message,",
        "so its recovery does not depend on the length. The ratio grows with the length: no one number, and the length",
        "that gives 5 is another for every message and link. The paper does not give its own.",
        f"Native ROS is nearer to Robofleet in {nearer} of {len(known)} cells: its queue of {queue_size} bounds what "
        "is left over;",
        "an unbounded one would be as rosbridge's, in smaller messages. To which of the two the paper found it similar "
        "we",
        "do not know.",
        "Not here: TCP's retransmission timer (silence_s stands in for it), sockets' own buffers, a ping after 2 s and",
        "a new connection.",
    ]


# --- the figure ------------------------------------------------------------------------------------------------------


def _draw_latency(axes: Any, seen: dict[str, tuple[float, Sent]], dropout_s: float, title: str) -> None:
    """Latency of what is received, against the time of receipt; 0 is the link's return."""
    for name in reversed(SENDERS):
        back_s, sent = seen[name]
        got = sent.got
        at_s = got.received_s - back_s
        look = {**style(name), "markersize": 3}
        for part in ((-dropout_s - 3 < at_s) & (at_s < 0), (0 <= at_s) & (at_s < dropout_s + 3)):
            axes.plot(at_s[part], got.latency_s[part], **look)
        axes.plot([], [], label=RIVALS[name].label, **look)
    axes.axvspan(-dropout_s, 0, color=COLOURS["other"], alpha=0.2, linewidth=0)
    axes.annotate("no link", (-dropout_s / 2, 0.02), xycoords=("data", "axes fraction"), ha="center", fontsize=8)
    axes.set(yscale="log", xlabel="receipt, s after the link's return", ylabel="latency, s")
    axes.set_title(title, loc="left", fontsize=10)
    axes.grid(alpha=0.25)


def _draw_ratios(axes: Any, cells: Cells) -> None:
    colours = dict(zip(RATES_HZ, (COLOURS["afr"], COLOURS["drop-oldest"], COLOURS["random"]), strict=True))
    links = list(dict.fromkeys(mbit for _, mbit, _ in cells))
    for (kind, mbit), found in _groups(cells).items():
        axes.plot(
            list(found),
            [ratio(cell) for cell in found.values()],
            color=colours[kind],
            marker="osD^vPX*"[links.index(mbit) % 8],
            markersize=4.5,
            linewidth=1.2,
            alpha=0.4 + 0.6 * (links.index(mbit) + 1) / len(links),
        )
    axes.axhspan(*ABOUT, color=COLOURS["other"], alpha=0.35, linewidth=0, label="paper, about 5")
    for kind in dict.fromkeys(kind for kind, _, _ in cells):
        axes.plot([], [], color=colours[kind], label=kind)
    for k, mbit in enumerate(links):
        axes.plot([], [], color=COLOURS["oracle"], marker="osD^vPX*"[k % 8], linestyle="", label=f"{mbit:g} Mbit/s")
    axes.set(xscale="log", yscale="log", xlabel="length of the dropout, s")
    lengths = sorted({dropout for _, _, dropout in cells})
    axes.set_xticks(lengths, [f"{d:g}" for d in lengths])
    axes.set_xticks([], minor=True)
    axes.set_yticks([1, 5, 10, 50, 100, 500], ["1", "5", "10", "50", "100", "500"])
    axes.set_title("Rosbridge's recovery time to Robofleet's", loc="left", fontsize=10)
    axes.grid(alpha=0.25)

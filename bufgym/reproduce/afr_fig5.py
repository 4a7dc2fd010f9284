"""Fig. 5 of the AFR paper: information gained during an interruption, against its length T.

L = 8, V(d) = 1 - 0.618^d (a camera moving back from a wall). The information gained is H - 1: as in the paper,
message 0, sent before, is left out. Random's band is one standard deviation to either side over its runs.

AFR equals oracle-ideal where its L + 1 gaps are equal: T + 1 = (L + 1) 2^k, which is T = 17, 35, 71 for L = 8. The
paper prints 18, 36, 72 for T; at those AFR is strictly below.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym import sim as sender
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym.oracle import interruption as oracle
from bufgym.reproduce.report import COLOURS, Report
from bufgym.scenario import Episode, Interruption

PAPER_L = 8
PAPER_RUNS = 10_000
"""Runs of Random for each T."""
PAPER_PEAKS = (18, 36, 72)
"""Where the paper says that AFR equals the oracle, as printed there (for T; it holds for T + 1)."""

MEAN_OVER = (9, 399)
"""First and last T of the printed mean of (H - 1) / oracle: every T from L + 1 on that a table of 400 reaches."""
EQUAL = 1e-12
"""Relative difference up to which two sums of V count as equal: rounding only."""
BATCH = 1000
"""Senders run at a time: a batch that fits in the processor's cache."""


def gained(policy: str, episodes: Sequence[Episode], capacity: int, v: Value) -> NDArray[np.float64]:
    """H - 1 of each episode under ``policy``, float64[episodes]."""
    done = sender.run(policies.get(policy), episodes, capacity, v)
    return np.array(done.batch.senders["delivered_gain"])


def gained_at_random(
    interruption: Interruption, T: int, capacity: int, runs: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """H - 1 of ``runs`` independent runs of Random over an interruption of T messages, float64[runs]."""
    parts = []
    episode = interruption.episode(T)
    for start in range(0, runs, BATCH):
        episodes = [episode.with_uniforms(rng) for _ in range(min(BATCH, runs - start))]
        parts.append(gained("random", episodes, capacity, interruption.value))
    return np.concatenate(parts)


def mean_score(policy: str, capacity: int, first: int, last: int) -> float:
    """Mean of (H - 1) / oracle over T = ``first``..``last``, V(d) = 1 - 0.618^d."""
    v = qoi.exponential(0.618)
    interruption = Interruption(law="fixed", t_max=last, value=v)
    lengths = range(first, last + 1)
    ours = gained(policy, [interruption.episode(T) for T in lengths], capacity, v)
    return float(np.mean(ours / [oracle.integer(capacity, T, v) for T in lengths]))


def report(runs: int = PAPER_RUNS, last_T: int = 80, seed: int = 0) -> Report:
    """Fig. 5 for T = 1..``last_T``, with ``runs`` runs of Random for each T."""
    if runs < 2 or last_T < 1:
        raise BufgymError(f"runs = {runs}, last_T = {last_T}: need runs >= 2 and last_T >= 1")
    L, v = PAPER_L, qoi.exponential(0.618)
    interruption = Interruption(law="fixed", t_max=last_T, value=v)
    lengths = np.arange(1, last_T + 1)
    episodes = [interruption.episode(int(T)) for T in lengths]
    rng = np.random.Generator(np.random.PCG64(seed))
    random = [gained_at_random(interruption, int(T), L, runs, rng) for T in lengths]
    curves: dict[str, NDArray[np.float64]] = {
        "oracle-ideal": np.array([oracle.ideal(L, int(T), v) for T in lengths]),
        "oracle": np.array([oracle.integer(L, int(T), v) for T in lengths]),
        "afr": gained("afr", episodes, L, v),
        "drop-oldest": gained("drop-oldest", episodes, L, v),
        "random": np.array([sample.mean() for sample in random]),
    }
    spread = np.array([sample.std(ddof=1) for sample in random])
    ideal, afr = curves["oracle-ideal"], curves["afr"]
    equal = [int(T) for T in lengths[(ideal - afr <= EQUAL * ideal) & (lengths > L)]]

    lines = [
        f"AFR paper, Fig. 5: information gained, H - 1. L = {L}, V(d) = 1 - 0.618^d, {runs} runs of Random for each T.",
        "",
        f"  T {''.join(f'{name:>14}' for name in curves)}     sd random",
    ]
    wanted = sorted({1, 8, 9, 17, 18, 25, 35, 36, 50, 71, 72, last_T})
    for i in (T - 1 for T in wanted if T <= last_T):
        lines.append(f"{lengths[i]:3d} {''.join(f'{c[i]:14.4f}' for c in curves.values())} {spread[i]:13.4f}")
    lines += ["", f"AFR = oracle-ideal beyond T = L: at T = {_join(equal)}; the paper prints T = {_join(PAPER_PEAKS)}."]
    below = [f"{T}: {afr[T - 1] / ideal[T - 1]:.5f}" for T in PAPER_PEAKS if T <= last_T]
    if below:
        lines.append(f"AFR / oracle-ideal at the printed T = {', '.join(below)}: these are T + 1 of the equal ones.")
    first, last = MEAN_OVER
    lines.append(f"Mean of (H - 1) / oracle over T = {first}..{last} (not in the paper):")
    lines += [f"  {name:12} {mean_score(name, L, first, last):.5f}" for name in ("afr", "drop-oldest")]

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        low, high = curves["random"] - spread, curves["random"] + spread
        axes.fill_between(lengths, low, high, color=COLOURS["random"], alpha=0.2, linewidth=0)
        styles = {"oracle-ideal": ":", "oracle": "--"}
        for name, curve in curves.items():
            label = {"afr": "AFR", "drop-oldest": "Drop Oldest", "random": "Random, mean ± 1 sd"}.get(name, name)
            axes.plot(lengths, curve, styles.get(name, "-"), color=COLOURS[name], label=label, linewidth=1.6)
        peaks = [T - 1 for T in equal]
        axes.plot(lengths[peaks], afr[peaks], "o", color=COLOURS["afr"], markersize=6, label="AFR = oracle-ideal")
        for i in peaks:
            axes.annotate(f"T = {lengths[i]}", (lengths[i], afr[i]), (-5, 7), textcoords="offset points", ha="right")
        axes.set(xlim=(0, last_T + 1), ylim=(0, L + 2), xlabel="T, messages during the interruption")
        axes.set_ylabel("information gained, H − 1")
        axes.set_title("Information gained in one interruption, L = 8, V(d) = 1 − 0.618$^d$", loc="left")
        axes.grid(alpha=0.25)
        axes.legend(loc="lower right", frameon=False, ncols=2)

    header = ["T", *curves, "random_sd"]
    rows = [
        [int(T), *(repr(float(c[i])) for c in curves.values()), repr(float(spread[i]))] for i, T in enumerate(lengths)
    ]
    return Report("\n".join(lines), header, rows, draw)


def _join(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers)) or "none"

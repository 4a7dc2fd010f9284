"""A picture of several policies on the same episode: a lane for each, with the messages that the server has seen."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.envs.render.image import COLOURS, canvas_of, pixels
from bufgym.envs.render.scene import DELIVERED, DROPPED, QUEUED, SENDING, STATES
from bufgym.policies import Policy
from bufgym.scenario import Episode, Scenario, Uplink
from bufgym.scenario.draws import shipped
from bufgym.sim import metrics
from bufgym.traces import Trace

WIDTH_PX = 800
_TOP_PX, _LANE_PX = 150, 90
"""Heights: of the link with the title and the legend, of each policy's lane."""
_SHADE, _HALF_SHADE_S = 0.4, 1.0
"""A gap of g s between messages received is shaded by _SHADE g / (g + _HALF_SHADE_S)."""
_SHADED_S = 0.1
"""Shorter gaps stay white."""
_NAMED_SHARE = 0.16
"""Gaps that take more of the lane have room for a label."""


@dataclass(frozen=True)
class Played:
    """One policy's run of one episode; arrays are by message, times in us, ``sim.NEVER`` where it did not happen."""

    policy: str
    """Its name."""
    h: float
    """QoI of what the server received."""
    arrival_us: NDArray[np.int64]
    """When it was taken."""
    x: NDArray[np.float64]
    """How far the scene had moved on by then."""
    dequeued_us: NDArray[np.int64]
    """When the socket took it."""
    received_us: NDArray[np.int64]
    """When the server had it."""
    dropped_us: NDArray[np.int64]
    """When it was dropped."""

    @property
    def received(self) -> NDArray[np.int64]:
        """Numbers of the messages that the server received."""
        return np.flatnonzero(self.received_us != sim.NEVER)

    @property
    def longest_gap_s(self) -> float:
        """Longest time between neighbouring messages received, s."""
        return float(np.diff(self.arrival_us[self.received]).max(initial=0)) / 1e6


def play(chosen: Sequence[str | Policy], episode: Episode, capacity: int, scenario: Scenario) -> list[Played]:
    """Each policy's run of the episode, in the order of ``chosen``."""
    runs = []
    for policy in map(policies.get, chosen):
        senders = sim.run(policy, [episode], capacity, scenario.value)
        arrivals, log = episode.arrivals, np.asarray(senders.batch.log[0])[: len(episode.arrivals)]
        crossed_us = log["transmitted_us"].copy()
        crossed_us[crossed_us != sim.NEVER] += episode.link.propagation_us
        runs.append(
            Played(
                policy.name,
                metrics.outcome(senders, 0).qoi,
                arrivals["arrival_us"].copy(),
                arrivals["x"].copy(),
                log["dequeued_us"].copy(),
                crossed_us,
                log["dropped_us"].copy(),
            )
        )
    return runs


def fading(top_bytes_per_s: float = 14e6, seconds: int = 12) -> Uplink:
    """A driving robot's camera over a link that fades to nothing and comes back, once, as cosine squared does."""
    steps = [(i + 0.5) / 20 for i in range(20 * seconds)]
    rates = [top_bytes_per_s * (0.5 + 0.5 * math.cos(2 * math.pi * t / seconds)) ** 2 for t in steps]
    link = Trace.steps([(0.05, rate) for rate in rates], name="fading")
    return Uplink((link,), motion=shipped()["motion"][:1], duration_s=seconds, random_offset=False, jitter=0.0)


def frames(runs: Sequence[Played], episode: Episode, title: str, count: int = 36) -> Iterator[NDArray[np.uint8]]:
    """``count`` images from the first arrival to the last receipt, the last one complete."""
    end_us = max(int(run.received_us[run.received].max(initial=0)) for run in runs)
    for now_us in np.linspace(end_us / count, end_us, count).astype(np.int64):
        yield image(runs, episode, int(now_us), title)


def save(runs: Sequence[Played], episode: Episode, path: str | Path, title: str = "") -> Path:
    """Write how the episode ended under each policy, as an image; return its path."""
    from matplotlib.image import imsave

    end_us = max(int(run.received_us[run.received].max(initial=0)) for run in runs)
    imsave(path, image(runs, episode, end_us, title))
    return Path(path)


def image(runs: Sequence[Played], episode: Episode, now_us: int, title: str) -> NDArray[np.uint8]:
    """The state at ``now_us``, uint8[height, 800, 3]."""
    height = _TOP_PX + _LANE_PX * len(runs)
    figure, canvas = canvas_of(WIDTH_PX, height)
    link, *lanes = figure.subplots(
        1 + len(runs),
        1,
        sharex=True,
        height_ratios=[0.8, *([1.0] * len(runs))],
        gridspec_kw={"left": 0.15, "right": 0.865, "top": 1 - 52 / height, "bottom": 34 / height, "hspace": 0.22},
    )
    end_s = float(runs[0].arrival_us[-1]) / 1e6
    figure.text(0.012, 1 - 18 / height, title, fontsize=10.5, weight="bold", va="center")
    _draw_link(link, episode, now_us, end_s)
    for axes, run in zip(lanes, runs, strict=True):
        _draw_lane(axes, run, now_us)
    for axes in (link, *lanes):
        axes.axvline(now_us / 1e6, color="black", linewidth=1)
        axes.set_xlim(-0.01 * end_s, 1.01 * end_s)
        axes.set_yticks([])
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right", "left"]].set_visible(False)
    lanes[-1].set_xlabel("time when the message was taken (s)", fontsize=8, labelpad=1)
    _legend(figure, 1 - 38 / height)
    return pixels(canvas)


def _draw_link(axes: Any, episode: Episode, now_us: int, end_s: float) -> None:
    """The link's capacity up to now against the demand; no higher than twice the demand."""
    arrivals = episode.arrivals
    edges_us = np.linspace(0, int(end_s * 1e6), 201).astype(np.int64)
    demand = 1e6 * float(arrivals["size_bytes"][:-1].sum()) / float(arrivals["arrival_us"][-1])
    trace, offset_us = episode.link.trace, episode.link.offset_us
    rates = trace.rate_bytes_per_s((edges_us[:-1] + edges_us[1:]) // 2 + offset_us) / demand
    shown = edges_us[1:] <= max(now_us, int(edges_us[1]))
    rates, edges_s = np.minimum(rates[shown], 2), edges_us[: int(shown.sum()) + 1] / 1e6
    axes.stairs(rates, edges_s, fill=True, color="#9cc3e6")
    axes.axhline(1, color="#555555", linestyle="--", linewidth=1)
    axes.set_ylim(0, 2.1)
    axes.text(-0.012, 0.5, "link", transform=axes.transAxes, ha="right", va="center", fontsize=9)
    axes.text(1.012, 0.48, "demand", transform=axes.transAxes, va="center", fontsize=8, color="#555555")


def _draw_lane(axes: Any, run: Played, now_us: int) -> None:
    """Ticks by the state of each message at ``now_us``; red where the server has seen nothing for long."""
    from matplotlib.colors import to_rgba  # of the extra "plot"

    states = states_at(run, now_us)
    arrival_s = run.arrival_us / 1e6
    heights = {DELIVERED: (0.25, 1.0), SENDING: (0.25, 1.0), QUEUED: (0.25, 1.0), DROPPED: (0.0, 0.17)}
    for state, (low, high) in heights.items():
        axes.vlines(arrival_s[states == state], low, high, color=COLOURS[state], linewidth=1.6)
    seen = np.flatnonzero(states == DELIVERED)
    left_s, gaps_s = arrival_s[seen[:-1]], np.diff(arrival_s[seen])
    left_s, gaps_s = left_s[gaps_s > _SHADED_S], gaps_s[gaps_s > _SHADED_S]
    shades = [to_rgba(COLOURS[DROPPED], _SHADE * gap_s / (gap_s + _HALF_SHADE_S)) for gap_s in gaps_s]
    axes.broken_barh(list(zip(left_s, gaps_s, strict=True)), (0.25, 0.75), facecolors=shades, linewidth=0)
    for start_s, gap_s in zip(left_s, gaps_s, strict=True):
        if gap_s > _NAMED_SHARE * arrival_s[-1]:
            middle, words = start_s + gap_s / 2, f"{gap_s:.1f} s unseen"
            axes.text(middle, 0.62, words, ha="center", va="center", fontsize=9, color=COLOURS[DROPPED])
    axes.set_ylim(0, 1.05)
    axes.text(-0.012, 0.5, run.policy, transform=axes.transAxes, ha="right", va="center", fontsize=9)
    words = f"{len(seen)} received\nH = {run.h:.2f}" if len(seen) == len(run.received) else f"{len(seen)} received"
    axes.text(1.012, 0.5, words, transform=axes.transAxes, va="center", fontsize=8.5)


def states_at(run: Played, now_us: int) -> NDArray[np.int64]:
    """int64[messages]: the state of each message at ``now_us``; -1 where it has not been taken yet."""
    states = np.where(run.arrival_us <= now_us, QUEUED, -1)
    for times_us, state in ((run.dequeued_us, SENDING), (run.received_us, DELIVERED), (run.dropped_us, DROPPED)):
        states[(times_us != sim.NEVER) & (times_us <= now_us)] = state
    return states


def _legend(figure: Any, y: float) -> None:
    x = 0.15
    for state in (DELIVERED, SENDING, QUEUED, DROPPED):
        figure.text(x, y, "❙", color=COLOURS[state], fontsize=9, va="center")
        figure.text(x + 0.014, y, STATES[state], fontsize=8, va="center", color="#555555")
        x += 0.045 + 0.011 * len(STATES[state])

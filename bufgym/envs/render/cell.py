"""The robots of one cell as text and as an image, a line for each."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.render.image import COLOURS, canvas_of, pixels
from bufgym.envs.render.scene import DELIVERED, DROPPED, QUEUED, SENDING
from bufgym.envs.sub_envs import SubEnvs

_QUEUED, _FREE = "■", "·"
_WIDEST = 32  # Largest L for which the text has a character for every slot; above it, two numbers
_MOST_LABELS = 32  # Most robots that have room for a label in the image


def cell_ansi(sub_envs: SubEnvs, names: list[str]) -> str:
    """A line for each robot: its buffer, whether it is sending, and the fate of its messages."""
    senders = sub_envs.senders.batch.senders
    lines = [_head(sub_envs)]
    for i, name in enumerate(names):
        sender, summary = senders[i], sub_envs.summary(i)
        queued, L = int(sender["occupancy"]), sub_envs.capacity
        buffer = _QUEUED * queued + _FREE * (L - queued) if L <= _WIDEST else f"{queued}/{L}"
        sending = "▶" if sender["busy"] else " "
        counts = f"delivered {summary['delivered']:>4}  dropped {summary['dropped']:>4}  H {summary['qoi']:.2f}"
        lines.append(f"{name:<9} {buffer} {sending} {counts}")
    return "\n".join(lines)


def cell_rgb_array(sub_envs: SubEnvs, names: list[str]) -> NDArray[np.uint8]:
    """An image uint8[400, 800, 3] with two bars for each robot: its messages so far and its buffer.

    Raises DependencyNotInstalled without matplotlib (the extra ``plot``).
    """
    figure, canvas = canvas_of()
    shares, buffers = figure.subplots(
        1, 2, sharey=True, width_ratios=(3, 1), gridspec_kw={"left": 0.1, "right": 0.985, "top": 0.86, "bottom": 0.09}
    )
    figure.subplots_adjust(wspace=0.05)
    figure.suptitle(_head(sub_envs), fontsize=10)
    senders, summary = sub_envs.senders.batch.senders, sub_envs.summary(slice(None))
    heights = np.arange(len(names))
    left = np.zeros(len(names))
    columns = (
        ("delivered", DELIVERED, summary["delivered"]),
        ("in transmission", SENDING, senders["busy"]),
        ("queued", QUEUED, senders["occupancy"]),
        ("dropped", DROPPED, summary["dropped"]),
    )
    for label, state, count in columns:
        shares.barh(heights, count, 0.8, left, color=COLOURS[state], label=label)
        left = left + count
    shares.set_xlim(0, max(1, int(np.max(left))))
    shares.set_xlabel("messages so far", fontsize=8, labelpad=1)
    shares.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=4, frameon=False, fontsize=8)
    buffers.barh(heights, senders["occupancy"], 0.8, color=COLOURS[QUEUED])
    buffers.set_xlim(0, sub_envs.capacity)
    buffers.set_xlabel(f"buffer, of L = {sub_envs.capacity}", fontsize=8, labelpad=1)
    shares.set_ylim(len(names) - 0.4, -0.6)
    labels = names if len(names) <= _MOST_LABELS else []
    shares.set_yticks(heights[: len(labels)], labels, fontsize=8 if len(names) <= _MOST_LABELS // 2 else 6)
    for axes in (shares, buffers):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(axis="x", labelsize=8)
    return pixels(canvas)


def _head(sub_envs: SubEnvs) -> str:
    senders: Any = sub_envs.senders.batch.senders
    return f"t = {senders['now_us'].max() / 1e6:.2f} s, {int(senders['busy'].sum())} of {len(senders)} sending"

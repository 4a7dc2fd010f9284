"""Pictures of one sender: kept and dropped messages as a timeline against the link's capacity.

``ansi`` gives a few lines of text, ``rgb_array`` an image of constant size. Both read the sender's arrays and change
nothing. The height of the capacity is measured in demand (the bytes that arrive per second): full height is twice the
demand, so wherever the capacity is below half height, messages must wait or be dropped.

With several topics each has a lane of its own, and a letter by which the queued messages are told apart.
"""

from __future__ import annotations

from typing import Any

from bufgym.envs.render.image import rgb_array
from bufgym.envs.render.text import ansi
from bufgym.sim import Senders

__all__ = ["ansi", "draw", "rgb_array"]


def draw(senders: Senders, i: int, render_mode: str) -> Any:
    """Sender ``i`` as ``render_mode`` asks: the text of "ansi" or the image of "rgb_array"."""
    return ansi(senders, i) if render_mode == "ansi" else rgb_array(senders, i)

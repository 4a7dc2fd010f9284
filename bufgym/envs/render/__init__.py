"""Pictures of one sender: kept and dropped messages as a timeline against the link's capacity.

``ansi`` gives a few lines of text, ``rgb_array`` an image of constant size, and ``Window`` shows images on the screen.
All read the sender's arrays and change nothing. The height of the capacity is in units of demand, the bytes that arrive
per second. Full height is twice the demand, so messages must wait or be dropped where the capacity is below half
height.

With several topics each has a lane and a letter of its own; letters tell queued messages apart.
"""

from typing import Any

from bufgym.envs.render.image import rgb_array
from bufgym.envs.render.text import ansi
from bufgym.envs.render.window import MOST, Window
from bufgym.sim import Senders

__all__ = ["MOST", "Window", "ansi", "draw", "rgb_array"]


def draw(senders: Senders, i: int, render_mode: str) -> Any:
    """Draw sender ``i``: text for the ``render_mode`` "ansi", an image for the others."""
    return ansi(senders, i) if render_mode == "ansi" else rgb_array(senders, i)

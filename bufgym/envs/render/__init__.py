"""Pictures of one sender: kept and dropped messages as a timeline against the link's capacity.

``ansi`` gives a few lines of text, ``rgb_array`` an image of constant size, and ``Window`` shows images on the screen.
All read the sender's arrays and change nothing. The height of the capacity is in units of demand, the bytes that arrive
per second. Full height is twice the demand, so messages must wait or be dropped where the capacity is below half
height.

With several topics each has a lane and a letter of its own; letters tell queued messages apart. Where actions choose
among candidates, the picture says which message each action stands for.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.render.image import rgb_array
from bufgym.envs.render.scene import NO_ACTIONS
from bufgym.envs.render.text import ansi
from bufgym.envs.render.window import MOST, Window
from bufgym.sim import Senders

__all__ = ["MOST", "Window", "ansi", "draw", "rgb_array"]


def draw(senders: Senders, i: int, render_mode: str, slot_actions: NDArray[np.int64] = NO_ACTIONS) -> Any:
    """Draw sender ``i``: text for the ``render_mode`` "ansi", an image for the others.

    ``slot_actions`` are the actions among slots that candidates' actions stand for, int64[actions]; none for others.
    """
    return (ansi if render_mode == "ansi" else rgb_array)(senders, i, slot_actions)

"""The window of ``render_mode="human"``: it shows the images of "rgb_array", so many a second."""

import math
import os
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bufgym.utils.errors import install

MOST = 16
"""Images shown at once, the first ones: a batch may have thousands of rows, and an image takes a 20th of a second."""
_ACROSS = 2  # Images of full size side by side; of more columns each is smaller


class Window:
    """Shows images side by side. Pygame has one window in a process: the environment that draws next takes it over.

    Raises DependencyNotInstalled without pygame or matplotlib (the extra ``human``).
    """

    def __init__(self) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        for name in ("pygame", "matplotlib"):
            try:
                import_module(name)
            except ImportError as error:
                message = f"render_mode='human' needs {name}: {install('human')}"
                raise gym.error.DependencyNotInstalled(message) from error
        self._clock: Any = None

    def __reduce__(self) -> Any:
        """A copy opens a window of its own when it draws."""
        return Window, ()

    def show(self, images: Sequence[NDArray[np.uint8]], frames_per_s: float) -> None:
        """Show images of one size, row by row; wait until the last ones were seen for a frame's time."""
        import pygame

        columns = math.ceil(math.sqrt(len(images)))
        scale = min(1.0, _ACROSS / columns)
        width, height = (round(scale * side) for side in images[0].shape[1::-1])
        size = (columns * width, math.ceil(len(images) / columns) * height)
        screen = pygame.display.get_surface() if pygame.display.get_init() else None
        if screen is None or screen.get_size() != size:
            pygame.display.init()
            screen = pygame.display.set_mode(size)
        pygame.display.set_caption("bufgym")
        screen.fill("white")
        for k, image in enumerate(images):
            picture = pygame.transform.smoothscale(pygame.surfarray.make_surface(image.swapaxes(0, 1)), (width, height))
            screen.blit(picture, (k % columns * width, k // columns * height))
        pygame.event.pump()  # a program that takes no events from the screen is taken for dead
        if self._clock is None:
            self._clock = pygame.time.Clock()
        self._clock.tick(frames_per_s)
        pygame.display.flip()

    def close(self) -> None:
        """Close the window, if this has shown anything."""
        if self._clock is not None:
            import pygame

            pygame.display.quit()
            self._clock = None

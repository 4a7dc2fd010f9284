"""A fixed set of a scenario's episodes, from which rows take theirs instead of drawing new ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bufgym.model.checks import whole
from bufgym.scenario.episode import Streams

MAX_EPISODES = 10**6
_SEED = 704_251
"""A seed that people do not use, so that rows of a benchmark differ from the episodes of a pool."""


class Pool:
    """``episodes`` episodes that ``draw`` draws, the same for everyone who makes a pool of it.

    Called with a row's streams, as ``draw`` is, it returns one of them at random. An episode is drawn at its first use
    and then stays in memory, 56 bytes a message.
    """

    def __init__(self, draw: Callable[[Streams], Any], episodes: int) -> None:
        self._draw = draw
        self._episodes: list[Any] = [None] * whole("pool", episodes, 1, MAX_EPISODES)

    def __len__(self) -> int:
        return len(self._episodes)

    def __call__(self, streams: Streams) -> Any:
        number = int(streams.link.integers(len(self)))
        if self._episodes[number] is None:
            self._episodes[number] = self._draw(Streams.seeded(np.random.SeedSequence([_SEED, number])))
        return self._episodes[number]

"""A recording with everything that runs on it share: its grid, the map of all frames, and what views have in common."""

import functools
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bufgym.scenario import Episode
from bufgym.traces import Trace
from bufgym_papers.perception import frames, mapping, orb, streams, tracking, views

WIDTH, VIEW_WIDTH = 160, 80
"""Image widths: frames are mapped and tracked at 160 x 120, and views are compared at 80 x 60. Tracking at 80 x 60
would take two thirds of the time, but it loses runs that are tracked at 160 x 120."""
OFFSETS: Final = 10  # Number of fade offsets; each shifts the fade earlier by a tenth of the stream
IMAGES: Final = "orbbuf-images"
"""ORBBuf that compares images; the policy is made for each episode and is not registered."""


class Stage:
    """A recording reduced to ``WIDTH``, with everything that runs on it share."""

    def __init__(self, whole: frames.Sequence) -> None:
        self.whole = whole
        self.sequence = whole.reduced(whole.camera.width // WIDTH).loaded()
        self.small = self.sequence.reduced(WIDTH // VIEW_WIDTH).loaded()

    @cached_property
    def grid(self) -> mapping.VoxelGrid:
        return mapping.grid_of(self.sequence)

    @cached_property
    def reference(self) -> mapping.Map:
        return self.map_of(range(len(self.sequence)))

    @cached_property
    def tracked_reference(self) -> mapping.Map:
        """The map that tracking makes of all frames, drift included."""
        return self.track_of(range(len(self.sequence))).model

    @cached_property
    def smooth(self) -> Callable[[int], frames.Depth]:
        """Depth of each frame as tracking smooths it, the same in every run."""
        return functools.cache(lambda k: tracking.smoothed(self.sequence.depth(k)))

    @cached_property
    def similar(self) -> orb.OrbSimilarity:
        """Similarity of the images at the sender's full size."""
        return orb.OrbSimilarity(self.whole.grey)

    @cached_property
    def seen(self) -> NDArray[np.float32]:
        """Overlap of views; see ``views.seen_shares``."""
        return views.seen_shares(self.small)

    @cached_property
    def coverage(self) -> views.Coverage:
        return views.Coverage(self.small)

    def episode(self, trace: Trace, k: int) -> Episode:
        """Make the episode of the stream over this link, with the fade k tenths of the stream earlier."""
        stream_us = int(self.whole.time_us[-1])
        link = streams.fading(stream_us, trace, k * stream_us // OFFSETS)
        return streams.episode(self.whole, streams.sizes(self.whole), link, seed=k)

    def kept(self, policy: str, trace: Trace, k: int, L: int) -> tuple[int, ...]:
        one = self.episode(trace, k)
        return streams.received(orb.orbbuf_by(self.similar, one) if policy == IMAGES else policy, one, L)

    def map_of(self, kept: Sequence[int]) -> mapping.Map:
        return mapping.fuse(self.sequence, kept, self.grid)

    def track_of(self, kept: Sequence[int]) -> tracking.Track:
        """Track along these frames; the track includes the map made until tracking broke."""
        return tracking.track(self.sequence, kept, self.grid, smooth=self.smooth)

    def mapped(self, kept: Sequence[int]) -> dict[str, Any]:
        return _errors(mapping.map_error(self.map_of(kept), self.reference))

    def tracked(self, kept: Sequence[int]) -> dict[str, Any]:
        """Track along these frames; report where tracking breaks and the error of its map until then. The reference is
        the tracked map of all frames: both maps drift alike, so they differ by the missing frames."""
        track = self.track_of(kept)
        found = _errors(mapping.map_error(track.model, self.tracked_reference))
        row: dict[str, Any] = {"failed": track.failed, "failed_at": track.where}
        return row | {f"slam_{name}": number for name, number in found.items()}


def _errors(error: mapping.MapError) -> dict[str, float]:
    """Convert a map's error to mm, with the fraction of the scene that it lacks."""
    return {
        "rmse_mm": 1e3 * error.rmse_m,
        "to_reference_mm": 1e3 * error.to_reference_m,
        "from_reference_mm": 1e3 * error.from_reference_m,
        "uncovered": error.uncovered,
    }

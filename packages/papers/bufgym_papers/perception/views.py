"""Overlap of a frame with other frames: a measurement of the V that the AFR paper assumes.

Each depth pixel of frame j is placed in the world and looked for in frame i. It was *seen* there if it falls into the
picture and the depth measured there agrees. Pixels where frame i measured nothing do not count. V(i, j) = 1 - seen(i,
j) is the part of frame j that is new after frame i.

This V depends on two frames, while the paper's depends on the distance between them; `afr-overlap` compares the two.
"""

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.utils.errors import BufgymError
from bufgym_papers.perception.frames import Sequence
from bufgym_papers.perception.mapping import points_of

AGREE: Final = 0.05  # Largest relative difference of agreeing depths, ten times a Kinect's noise at 3 m
POINTS_ACROSS: Final = 20  # Pixels per row that are looked for; few are enough, because views overlap in large pieces
CELL_M: Final = 0.1  # Side of the cells in which coverage is counted, m
LEAST_VIEWS: Final = 3
"""Frames that must have seen a cell for it to count; cells seen by fewer are mostly noise at edges."""


@kernel
def _all_shares(depths: Any, poses: Any, lens: Any, stride: int, result: Any) -> None:
    """Write the part of frame j that frame i has seen, for every i and each later j; 0 if frame i measured none of it.

    ``depths`` are in m, ``poses`` take a camera to the world, ``stride`` is the step between the pixels of frame j that
    are looked for, and ``result`` is float32[frames, frames].
    """
    height, width = depths.shape[1], depths.shape[2]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for i in range(len(depths)):
        for j in range(i + 1, len(depths)):
            seen, known = 0, 0
            for v in range(stride // 2, height, stride):
                for u in range(stride // 2, width, stride):
                    z = float(depths[j, v, u])
                    if z <= 0.0:
                        continue
                    x, y = (u - cx) * z / fx, (v - cy) * z / fy
                    # To the world by pose j, relative to camera i's position ...
                    dx = poses[j, 0, 0] * x + poses[j, 0, 1] * y + poses[j, 0, 2] * z + poses[j, 0, 3] - poses[i, 0, 3]
                    dy = poses[j, 1, 0] * x + poses[j, 1, 1] * y + poses[j, 1, 2] * z + poses[j, 1, 3] - poses[i, 1, 3]
                    dz = poses[j, 2, 0] * x + poses[j, 2, 1] * y + poses[j, 2, 2] * z + poses[j, 2, 3] - poses[i, 2, 3]
                    # ... and into camera i's axes by the transposed rotation.
                    away = poses[i, 0, 2] * dx + poses[i, 1, 2] * dy + poses[i, 2, 2] * dz
                    if away <= 0.0:
                        known += 1
                        continue
                    right = poses[i, 0, 0] * dx + poses[i, 1, 0] * dy + poses[i, 2, 0] * dz
                    down = poses[i, 0, 1] * dx + poses[i, 1, 1] * dy + poses[i, 2, 1] * dz
                    across, along = right / away * fx + cx + 0.5, down / away * fy + cy + 0.5
                    if not (0.0 <= across < width and 0.0 <= along < height):
                        known += 1
                        continue
                    measured = float(depths[i, int(along), int(across)])
                    if measured > 0.0:
                        known += 1
                        seen += abs(measured - away) <= AGREE * away
            result[i, j] = seen / known if known > 0 else 0.0


def seen_shares(sequence: Sequence) -> NDArray[np.float32]:
    """Part of frame j that frame i has seen, at [i, j] of float32[frames, frames] for i <= j; 0 below.

    About 10 us a pair: some seconds for a thousand frames.
    """
    depths = np.stack([sequence.depth(k) for k in range(len(sequence))])
    seen, stride = np.eye(len(sequence), dtype=np.float32), max(1, sequence.camera.width // POINTS_ACROSS)
    _all_shares(depths, np.ascontiguousarray(sequence.poses), sequence.camera.lens, stride, seen)
    return seen


def least_overlap(seen: NDArray[np.float32], frames: Iterable[int]) -> float:
    """Least overlap of consecutive frames: the part of a frame that the one before it has seen.

    It is 1 for fewer than two frames. A tracker needs this rather than H, because the worst step loses it, not the sum.
    """
    kept = np.fromiter(frames, np.int64)
    return float(seen[kept[:-1], kept[1:]].min()) if len(kept) > 1 else 1.0


class Coverage:
    """Part of the scene that some frames have seen, in any order: a measure for robots that revisit places.

    H counts a view that is new since the frame *before*, so a revisited place counts twice. Coverage counts each cell
    of the scene once. It is no sum over gaps: a frame's contribution depends on all others, so policies cannot learn it
    message by message. Coverage measures runs and rewards them at their end.
    """

    def __init__(self, sequence: Sequence, least_views: int = LEAST_VIEWS) -> None:
        """Look at every frame of the sequence once."""
        cells = [np.unique(_cells(sequence, k)) for k in range(len(sequence))]
        every, number, views = np.unique(np.concatenate(cells), return_inverse=True, return_counts=True)
        frame = np.repeat(np.arange(len(cells)), [len(rows) for rows in cells])
        counts = views >= least_views
        if not counts.any():
            raise BufgymError(f"{sequence.name}: no cell of {CELL_M:g} m was seen by {least_views} of its frames")
        saw = np.zeros((len(cells), len(every)), np.bool_)
        saw[frame, number] = True
        self._saw = np.packbits(saw[:, counts], axis=1)
        self.cells = int(counts.sum())  # number of cells that count

    def share(self, frames: Iterable[int]) -> float:
        """Part of all cells that these frames have seen, in [0, 1]."""
        seen = np.bitwise_or.reduce(self._saw[np.fromiter(frames, np.int64)], axis=0)
        return int(np.bitwise_count(seen).sum()) / self.cells


def _cells(sequence: Sequence, k: int) -> NDArray[np.int64]:
    """Cell of each point that frame k measured, 20 bits for each of x, y and z, int64[points]."""
    pose = sequence.poses[k]
    world = points_of(sequence.depth(k), sequence.camera, near_m=0.0, far_m=np.inf) @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = np.floor(world / CELL_M).astype(np.int64).T + 2**19
    return np.asarray((x << 40) + (y << 20) + z, np.int64)

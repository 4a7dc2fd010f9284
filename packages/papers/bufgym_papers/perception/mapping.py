"""Map of the frames that arrived, and its distance from the map of all frames.

Frames are fused with their true poses, so all errors of the map come from missing frames.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from bufgym.traces.trace import Float64Array
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library
from bufgym_papers.perception import tsdf
from bufgym_papers.perception.frames import Camera, Sequence

VOXEL_M: Final = 0.04  # Edge of a voxel by default, m: at 160x120 pixels are 1.4 cm apart on a wall at 2 m
TRUNCATION_VOXELS: Final = 3.0  # Distance from the surface up to which the function is kept, in voxels
FAR_M: Final = 4.5  # Largest depth used, m; a Kinect's depth there is off by 6 cm already
COVERED_M: Final = 0.05  # A part of the reference is uncovered if the map has no point within this distance, m
MOST_VOXELS: Final = 2**25  # A larger grid would take more than 256 MB

_BOX_STRIDE: Final = 8  # step between the frames and pixels that measure the box


@dataclass(frozen=True)
class VoxelGrid:
    """Positions of the voxels."""

    origin_m: tuple[float, float, float]  # centre of the first voxel, world coordinates, m
    shape: tuple[int, int, int]  # voxels along x, y and z
    voxel_m: float = VOXEL_M  # edge of a voxel, m

    def __post_init__(self) -> None:
        if min(self.shape) < 2 or math.prod(self.shape) > MOST_VOXELS:
            size = " x ".join(str(count) for count in self.shape)
            raise BufgymError(f"grid of {size} voxels: must be at least 2 a side and {MOST_VOXELS} in all")

    @property
    def truncation_m(self) -> float:
        """Distance from the surface up to which the function is kept, m."""
        return TRUNCATION_VOXELS * self.voxel_m


def grid_of(sequence: Sequence) -> VoxelGrid:
    """VoxelGrid of the box around all points of a recording, with a margin of the truncation."""
    stride = _BOX_STRIDE if min(sequence.camera.width, sequence.camera.height) >= 4 * _BOX_STRIDE else 1
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for k in range(0, len(sequence), _BOX_STRIDE):
        points = points_of(sequence.depth(k)[::stride, ::stride], sequence.camera, stride)
        if len(points):
            seen = points @ sequence.poses[k, :3, :3].T + sequence.poses[k, :3, 3]
            low, high = np.minimum(low, seen.min(axis=0)), np.maximum(high, seen.max(axis=0))
    if not np.isfinite(low).all():
        raise BufgymError(f"{sequence.name}: no frame holds a depth from {tsdf.NEAR_M} to {FAR_M} m")
    margin = TRUNCATION_VOXELS * VOXEL_M
    count = np.ceil((high - low + 2 * margin) / VOXEL_M).astype(int) + 1
    x, y, z = (low - margin).tolist()
    return VoxelGrid((x, y, z), (int(count[0]), int(count[1]), int(count[2])))


def points_of(
    depth: npt.NDArray[np.float32], camera: Camera, stride: int = 1, near_m: float = tsdf.NEAR_M, far_m: float = FAR_M
) -> Float64Array:
    """The points of a depth image of every ``stride``-th pixel, in the camera's frame, float64[m, 3]."""
    v, u = np.nonzero((depth > 0) & (depth >= near_m) & (depth <= far_m))
    z = depth[v, u].astype(np.float64)
    x, y = (stride * u - camera.cx) * z / camera.fx, (stride * v - camera.cy) * z / camera.fy
    return np.stack([x, y, z], axis=1)


@dataclass(frozen=True, eq=False)
class Map:
    """A truncated signed distance function."""

    grid: VoxelGrid
    tsdf: npt.NDArray[np.float32]  # float32[grid.shape], -1..1, in units of the truncation
    weight: npt.NDArray[np.float32]  # float32[grid.shape], number of frames averaged in each voxel

    @staticmethod
    def empty(grid: VoxelGrid) -> Map:
        return Map(grid, np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32))

    def add(
        self, depth: npt.NDArray[np.float32], camera: Camera, pose: Float64Array, most_weight: float = math.inf
    ) -> None:
        """Fuse one frame seen from ``pose``, camera to world; weights grow up to ``most_weight``."""
        to_camera, grid = np.linalg.inv(pose), self.grid
        place = np.array(grid.origin_m), grid.voxel_m, grid.truncation_m
        tsdf.integrate(depth, FAR_M, camera.lens, to_camera, *place, most_weight, self.tsdf, self.weight)

    def points(self) -> Float64Array:
        """Points where the surface crosses edges between voxels, float64[m, 3], world coordinates, m."""
        return np.array(self.grid.origin_m) + self.grid.voxel_m * tsdf.surface(self.tsdf, self.weight)


def fuse(sequence: Sequence, frames: Iterable[int], grid: VoxelGrid | None = None) -> Map:
    """Fuse these frames into a map, in the given order with their true poses.

    ``grid`` is by default the whole recording's, so that maps of different frames are comparable.
    """
    result = Map.empty(grid or grid_of(sequence))
    for k in frames:
        result.add(sequence.depth(k), sequence.camera, sequence.poses[k])
    return result


@dataclass(frozen=True)
class MapError:
    """Distance of a map from a reference, cloud to cloud."""

    to_reference_m: float
    """Root mean square distance from the map's points to the nearest reference points, m; shows wrong parts."""
    from_reference_m: float  # the same from the reference's points to the map's, m; shows missing parts too
    uncovered: float  # share of the reference's points without a point of the map within `COVERED_M`

    @property
    def rmse_m(self) -> float:
        """Root mean square of both directions with equal weight, m."""
        return math.sqrt((self.to_reference_m**2 + self.from_reference_m**2) / 2)


def distances(points: Float64Array, reference: Float64Array) -> Float64Array:
    """Distance of each point from the nearest reference point, float64[m], m."""
    nearest, _ = library("scipy.spatial", "bufgym-papers[perception]").cKDTree(reference).query(points)
    return np.asarray(nearest, np.float64)


def map_error(found: Map, reference: Map) -> MapError:
    """Measure the map's distance from the reference, usually the map of all frames."""
    clouds = {"map": found.points(), "reference": reference.points()}
    for name, cloud in clouds.items():
        if not len(cloud):
            raise BufgymError(f"the {name} holds no surface: must be of at least one frame with depth")
    there, back = (distances(clouds[a], clouds[b]) for a, b in itertools.permutations(clouds))
    rms = [float(np.sqrt(np.mean(d**2))) for d in (there, back)]
    return MapError(rms[0], rms[1], float(np.mean(back > COVERED_M)))

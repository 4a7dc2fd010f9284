"""Slow and obvious twins of the kernels in bufgym/papers/perception/tsdf.py and icp.py."""

import numpy as np

from bufgym.papers.perception.frames import Camera, Depth
from bufgym.papers.perception.mapping import FAR_M, Grid
from bufgym.papers.perception.tsdf import NEAR_M


def integrate(grid: Grid, depth: Depth, camera: Camera, pose: np.ndarray, tsdf: np.ndarray, weight: np.ndarray) -> None:
    """Every voxel asks the pixel that sees it how far the surface is behind it."""
    to_camera = np.linalg.inv(pose)
    for index in np.ndindex(grid.shape):
        x, y, z = (to_camera @ [*(np.array(grid.origin_m) + grid.voxel_m * np.array(index)), 1.0])[:3]
        if not NEAR_M <= z <= FAR_M + grid.truncation_m:
            continue
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            continue
        measured = float(depth[row, column])
        if not NEAR_M <= measured <= FAR_M or measured - z < -grid.truncation_m:
            continue
        w = weight[index]
        tsdf[index] = (tsdf[index] * w + min(1.0, (measured - z) / grid.truncation_m)) / (w + 1)
        weight[index] = w + 1


def surface(grid: Grid, tsdf: np.ndarray, weight: np.ndarray) -> set[tuple[float, ...]]:
    """Where neighbours have different signs, each the linear zero between them, in mm."""
    found = set()
    for index in np.ndindex(grid.shape):
        for axis in range(3):
            other = tuple(i + (a == axis) for a, i in enumerate(index))
            if other[axis] == grid.shape[axis] or not (weight[index] and weight[other]):
                continue
            a, b = float(tsdf[index]), float(tsdf[other])
            if max(a, b) < 1 and (a < 0) != (b < 0):
                place = np.array(index, float)
                place[axis] += a / (a - b)
                found.add(tuple(np.round(1000 * (np.array(grid.origin_m) + grid.voxel_m * place), 2).tolist()))
    return found

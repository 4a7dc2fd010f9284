"""Truncated signed distance function on a voxel grid: fuses depth images and renders the surface from a pose.

B. Curless, M. Levoy, "A Volumetric Method for Building Complex Models from Range Images", SIGGRAPH 1996, as in
R. A. Newcombe et al., "KinectFusion: Real-Time Dense Surface Mapping and Tracking", ISMAR 2011. A voxel holds the mean
distance to the surface along the viewing direction, in units of the truncation: 1 = free, 0 = surface, below = behind.

Kernels take ``lens`` = (fx, fy, cx, cy) as float64[4] and poses as float64[4, 4]. Sums are taken in a fixed order.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel

NEAR_M = 0.3  # Least depth used, m; a Kinect measures from 0.4 m on


@kernel
def integrate(
    depth: Any,
    far_m: float,
    lens: Any,
    to_camera: Any,
    origin_m: Any,
    voxel_m: float,
    truncation_m: float,
    most_weight: float,
    tsdf: Any,
    weight: Any,
) -> None:
    """Add one depth image, seen from ``to_camera``, to every voxel that it informs.

    Along a column of voxels the image coordinates' numerators and the depth are linear, so the stretch inside the
    field of view follows from six inequalities, and no other voxel is touched.
    """
    height, width = depth.shape
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    m = to_camera
    dx, dy, dz = m[0, 2] * voxel_m, m[1, 2] * voxel_m, m[2, 2] * voxel_m
    for i in range(tsdf.shape[0]):
        for j in range(tsdf.shape[1]):
            wx, wy, wz = origin_m[0] + i * voxel_m, origin_m[1] + j * voxel_m, origin_m[2]
            x = m[0, 0] * wx + m[0, 1] * wy + m[0, 2] * wz + m[0, 3]
            y = m[1, 0] * wx + m[1, 1] * wy + m[1, 2] * wz + m[1, 3]
            z = m[2, 0] * wx + m[2, 1] * wy + m[2, 2] * wz + m[2, 3]
            low, high = 0.0, tsdf.shape[2] - 1.0
            low, high = _clipped(low, high, z - NEAR_M, dz)
            low, high = _clipped(low, high, far_m + truncation_m - z, -dz)
            low, high = _clipped(low, high, fx * x + (cx + 0.5) * z, fx * dx + (cx + 0.5) * dz)
            low, high = _clipped(low, high, (width - 0.5 - cx) * z - fx * x, (width - 0.5 - cx) * dz - fx * dx)
            low, high = _clipped(low, high, fy * y + (cy + 0.5) * z, fy * dy + (cy + 0.5) * dz)
            low, high = _clipped(low, high, (height - 0.5 - cy) * z - fy * y, (height - 0.5 - cy) * dz - fy * dy)
            if not low <= high:
                continue
            for k in range(math.ceil(low), math.floor(high) + 1):
                pz = z + k * dz
                u = int(fx * (x + k * dx) / pz + cx + 0.5)
                v = int(fy * (y + k * dy) / pz + cy + 0.5)
                if u >= width or v >= height:
                    continue  # outside by rounding alone
                measured = depth[v, u]
                if measured < NEAR_M or measured > far_m:
                    continue
                distance = measured - pz
                if distance < -truncation_m:
                    continue  # hidden, so unknown
                value = min(1.0, distance / truncation_m)
                w = weight[i, j, k]
                tsdf[i, j, k] = (tsdf[i, j, k] * w + value) / (w + 1.0)
                weight[i, j, k] = min(w + 1.0, most_weight)


@kernel
def _clipped(low: float, high: float, start: float, step: float) -> tuple[float, float]:
    """Clip low..high to where start + k step >= 0; the empty range is (1, 0)."""
    if step > 0.0:
        return max(low, -start / step), high
    if step < 0.0:
        return low, min(high, -start / step)
    return (low, high) if start >= 0.0 else (1.0, 0.0)


def surface(tsdf: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float64]:
    """Crossings of the surface with edges between seen voxels, float64[m, 3], in voxels."""
    known = (weight > 0) & (tsdf < 1)
    crossed = np.zeros((*tsdf.shape, 3), np.bool_)
    for axis in range(3):
        near = tuple(slice(None, -1) if other == axis else slice(None) for other in range(3))
        far = tuple(slice(1, None) if other == axis else slice(None) for other in range(3))
        crossed[(*near, axis)] = known[near] & known[far] & ((tsdf[near] < 0) != (tsdf[far] < 0))
    *place, along = np.nonzero(crossed)
    a, b = tsdf[*place], tsdf[*(index + (along == axis) for axis, index in enumerate(place))]
    points = np.stack(place, axis=1).astype(np.float64)
    points[np.arange(len(along)), along] += a / (a - b)
    return points


@kernel
def _trilinear(tsdf: Any, weight: Any, x: float, y: float, z: float) -> float:
    """Interpolate the function at grid coordinates; 2 where one of the eight voxels around was never seen."""
    i, j, k = int(x), int(y), int(z)
    if x < 0.0 or y < 0.0 or z < 0.0:
        return 2.0
    if i + 1 >= tsdf.shape[0] or j + 1 >= tsdf.shape[1] or k + 1 >= tsdf.shape[2]:
        return 2.0
    a, b, c = x - i, y - j, z - k
    total = 0.0
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                if weight[i + di, j + dj, k + dk] == 0.0:
                    return 2.0
                share = (a if di else 1.0 - a) * (b if dj else 1.0 - b) * (c if dk else 1.0 - c)
                total += share * tsdf[i + di, j + dj, k + dk]
    return total


@kernel
def raycast(
    tsdf: Any,
    weight: Any,
    origin_m: Any,
    voxel_m: float,
    truncation_m: float,
    far_m: float,
    lens: Any,
    to_world: Any,
    hint: Any,
    vertices: Any,
) -> None:
    """Render the surface as seen from ``to_world``, float32[height, width, 3] in the world, NaN where none is seen.

    ``hint`` float32[height, width] is a depth that was fused from this pose, or 0. Space in front of it by more than
    the truncation is free, so the ray begins there. Each step is as long as the function says is free, from a voxel to
    0.8 of the truncation, and equally long in unknown space. The surface lies where the function passes from positive
    to negative with both sides known.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    m = to_world
    for v in range(vertices.shape[0]):
        for u in range(vertices.shape[1]):
            vertices[v, u, 0] = vertices[v, u, 1] = vertices[v, u, 2] = math.nan
            # A step of 1 in z, in world coordinates and in voxels.
            a, b = (u - cx) / fx, (v - cy) / fy
            wx = m[0, 0] * a + m[0, 1] * b + m[0, 2]
            wy = m[1, 0] * a + m[1, 1] * b + m[1, 2]
            wz = m[2, 0] * a + m[2, 1] * b + m[2, 2]
            gx, gy, gz = wx / voxel_m, wy / voxel_m, wz / voxel_m
            ox = (m[0, 3] - origin_m[0]) / voxel_m
            oy = (m[1, 3] - origin_m[1]) / voxel_m
            oz = (m[2, 3] - origin_m[2]) / voxel_m
            low, high = max(NEAR_M, hint[v, u] - 1.5 * truncation_m), far_m
            low, high = _clipped(low, high, ox, gx)
            low, high = _clipped(low, high, tsdf.shape[0] - 1.0 - ox, -gx)
            low, high = _clipped(low, high, oy, gy)
            low, high = _clipped(low, high, tsdf.shape[1] - 1.0 - oy, -gy)
            low, high = _clipped(low, high, oz, gz)
            low, high = _clipped(low, high, tsdf.shape[2] - 1.0 - oz, -gz)
            z, before, step = low, -1.0, 0.0
            while z < high:
                i, j, k = int(ox + gx * z + 0.5), int(oy + gy * z + 0.5), int(oz + gz * z + 0.5)
                if weight[i, j, k] == 0.0:
                    before, step = -1.0, 0.8 * truncation_m
                else:
                    value = tsdf[i, j, k]
                    if value < 0.0:
                        if before >= 0.0:
                            back = z - step
                            near = _trilinear(tsdf, weight, ox + gx * back, oy + gy * back, oz + gz * back)
                            far = _trilinear(tsdf, weight, ox + gx * z, oy + gy * z, oz + gz * z)
                            if far < near < 2.0:
                                hit = back + step * near / (near - far)
                                vertices[v, u, 0] = m[0, 3] + wx * hit
                                vertices[v, u, 1] = m[1, 3] + wy * hit
                                vertices[v, u, 2] = m[2, 3] + wz * hit
                        break
                    before, step = value, max(voxel_m, 0.8 * truncation_m * value)
                z += step

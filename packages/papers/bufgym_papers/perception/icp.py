"""Camera pose from the surface that it should see: point-to-plane iterated closest points by projection.

R. A. Newcombe et al., "KinectFusion: Real-Time Dense Surface Mapping and Tracking", ISMAR 2011, Sec. 3.5. A measured
point is paired with the model's point behind the same pixel. The pose moves so that the measured points lie in the
model's planes.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel


@kernel
def smooth(depth: Any, radius: int, same_surface: float, result: Any) -> None:
    """Average each depth with its neighbours on the same surface, within the share ``same_surface`` of the depth."""
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            centre = depth[v, u]
            total, count = 0.0, 0
            if centre > 0.0:
                for y in range(max(0, v - radius), min(height, v + radius + 1)):
                    for x in range(max(0, u - radius), min(width, u + radius + 1)):
                        if abs(depth[y, x] - centre) <= same_surface * centre:
                            total += depth[y, x]
                            count += 1
            result[v, u] = total / count if count else 0.0


def unproject(depth: NDArray[np.float32], far_m: float, lens: NDArray[np.float64]) -> NDArray[np.float32]:
    """Find the points of a depth image in the camera's frame, float32[height, width, 3], NaN without a point."""
    v, u = np.indices(depth.shape)
    z = np.where((depth > 0) & (depth <= far_m), depth, np.nan).astype(np.float64)
    points = np.stack([(u - lens[2]) / lens[0] * z, (v - lens[3]) / lens[1] * z, z], axis=2)
    return points.astype(np.float32)


@kernel
def orient(vertices: Any, eye: Any, same_surface: float, normals: Any) -> None:
    """Normals towards ``eye`` from the points at the four neighbours; NaN where one is missing or on another surface.

    Neighbours on one surface are nearer to a point than the share ``same_surface`` of its distance. ``vertices`` and
    ``normals``, which is written, are float32[height, width, 3].
    """
    height, width = vertices.shape[0], vertices.shape[1]
    for v in range(height):
        for u in range(width):
            normals[v, u, 0] = normals[v, u, 1] = normals[v, u, 2] = math.nan
            if u == 0 or v == 0 or u == width - 1 or v == height - 1:
                continue
            ax = vertices[v, u + 1, 0] - vertices[v, u - 1, 0]
            ay = vertices[v, u + 1, 1] - vertices[v, u - 1, 1]
            az = vertices[v, u + 1, 2] - vertices[v, u - 1, 2]
            bx = vertices[v + 1, u, 0] - vertices[v - 1, u, 0]
            by = vertices[v + 1, u, 1] - vertices[v - 1, u, 1]
            bz = vertices[v + 1, u, 2] - vertices[v - 1, u, 2]
            ex, ey, ez = eye[0] - vertices[v, u, 0], eye[1] - vertices[v, u, 1], eye[2] - vertices[v, u, 2]
            reach = (2.0 * same_surface) ** 2 * (ex * ex + ey * ey + ez * ez)
            # Written so that a missing neighbour, NaN, fails the test.
            if not (ax * ax + ay * ay + az * az < reach and bx * bx + by * by + bz * bz < reach):
                continue
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if not length > 0.0:
                continue
            if nx * ex + ny * ey + nz * ez < 0.0:
                length = -length
            normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = nx / length, ny / length, nz / length


@kernel
def normal_equations(
    points: Any,
    point_normals: Any,
    stride: int,
    pose: Any,
    model: Any,
    model_normals: Any,
    to_model_camera: Any,
    lens: Any,
    apart_m: float,
    cosine: float,
    jacobian: Any,
    sums: Any,
) -> int:
    """Sum the normal equations that move ``pose`` by a small rotation and translation (rx, ry, rz, tx, ty, tz).

    Args:
        points, point_normals: points of the frame and their normals, in its camera's frame.
        stride: step between the pixels and rows used.
        pose: float64[4, 4], camera to world, the estimate so far.
        model, model_normals: the surface as seen from another pose, in the world.
        to_model_camera: float64[4, 4], world to the camera of that pose.
        lens: lens of the model's camera.
        apart_m: pairs farther apart are none, m.
        cosine: pairs whose normals differ by more than the angle of this cosine are none.
        jacobian: float64[8], scratch: one pair's 6 derivatives of the distance to the plane, that distance, and 1.
        sums: float64[8, 8], written: the sum of jacobian^T jacobian over all pairs; its last element is their number.

    Returns the number of points with a normal, paired or not.
    """
    height, width = model.shape[0], model.shape[1]
    m, c = pose, to_model_camera
    count = 0
    for a in range(8):
        for b in range(8):
            sums[a, b] = 0.0
    for v in range(0, points.shape[0], stride):
        for u in range(0, points.shape[1], stride):
            lx, ly, lz = point_normals[v, u, 0], point_normals[v, u, 1], point_normals[v, u, 2]
            if math.isnan(lx):
                continue
            count += 1
            px, py, pz = points[v, u, 0], points[v, u, 1], points[v, u, 2]
            x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
            y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
            z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            qz = c[2, 0] * x + c[2, 1] * y + c[2, 2] * z + c[2, 3]
            if qz <= 0.0:
                continue
            col = math.floor(lens[0] * (c[0, 0] * x + c[0, 1] * y + c[0, 2] * z + c[0, 3]) / qz + lens[2] + 0.5)
            row = math.floor(lens[1] * (c[1, 0] * x + c[1, 1] * y + c[1, 2] * z + c[1, 3]) / qz + lens[3] + 0.5)
            if col < 0 or row < 0 or col >= width or row >= height:
                continue
            nx, ny, nz = model_normals[row, col, 0], model_normals[row, col, 1], model_normals[row, col, 2]
            dx, dy, dz = x - model[row, col, 0], y - model[row, col, 1], z - model[row, col, 2]
            if not dx * dx + dy * dy + dz * dz < apart_m * apart_m:  # also rejects NaN
                continue
            wx = m[0, 0] * lx + m[0, 1] * ly + m[0, 2] * lz
            wy = m[1, 0] * lx + m[1, 1] * ly + m[1, 2] * lz
            wz = m[2, 0] * lx + m[2, 1] * ly + m[2, 2] * lz
            if not wx * nx + wy * ny + wz * nz > cosine:
                continue
            jacobian[0], jacobian[1], jacobian[2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            jacobian[3], jacobian[4], jacobian[5], jacobian[6] = nx, ny, nz, dx * nx + dy * ny + dz * nz
            jacobian[7] = 1.0
            for a in range(8):
                factor = jacobian[a]
                for b in range(8):  # all eight although the sums are symmetric, so that the loop is vectorised
                    sums[a, b] += factor * jacobian[b]
    return count

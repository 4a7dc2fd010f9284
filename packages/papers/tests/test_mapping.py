"""Maps: a flat wall by hand, a slow reference model, the error of a shifted plane, the same bits every time."""

import frame_cases
import numpy as np
import pytest
from refusal_cases import refused

from bufgym_papers.perception.frames import Camera, Depth
from bufgym_papers.perception.mapping import COVERED_M, FAR_M, Map, VoxelGrid, fuse, grid_of, map_error
from bufgym_papers.perception.tsdf import NEAR_M

pytestmark = pytest.mark.kernels
CAMERA = Camera(8, 6, 4.0, 4.0, 3.5, 2.5)
AHEAD = VoxelGrid((0.0, 0.0, 0.4), (2, 2, 12), 0.1)
"""Columns of voxels straight ahead, at 0.4, 0.5 ... 1.5 m; the truncation is 0.3 m."""


def wall(*depths_m: float, camera: Camera = CAMERA) -> frame_cases.Held:
    """A flat wall at each of these distances, a frame each, all seen from the origin."""
    shape = (camera.height, camera.width)
    depths = [np.full(shape, depth_m, np.float32) for depth_m in depths_m]
    return frame_cases.Held(camera, depths, [np.eye(4)] * len(depths))


def test_flat_walls_as_worked_by_hand() -> None:
    """At 1 m: free up to 0.7 m, then (1 - z) / 0.3, nothing known behind 1.3 m."""
    found = fuse(wall(1.0), [0], AHEAD)
    assert found.tsdf[0, 0] == pytest.approx([1, 1, 1, 1, 2 / 3, 1 / 3, 0, -1 / 3, -2 / 3, -1, 0, 0], abs=1e-6)
    assert found.weight[0, 0].tolist() == [1] * 10 + [0] * 2
    assert found.points()[:, 2] == pytest.approx(np.ones(4), abs=1e-6)
    # The grid of its own, of 4 cm, holds all that was seen.
    grid = grid_of(wall(1.0))
    high = np.array(grid.origin_m) + grid.voxel_m * (np.array(grid.shape) - 1)
    assert grid.origin_m == pytest.approx([-3.5 / 4 - 0.12, -2.5 / 4 - 0.12, 0.88])
    assert (high >= [3.5 / 4 + 0.12, 2.5 / 4 + 0.12, 1.12 - 1e-9]).all()
    # Two frames meet in the middle; with a memory of one frame the third counts half; one without depth nothing.
    found = fuse(wall(1.0, 1.1), [0, 1], AHEAD)
    assert found.points()[:, 2] == pytest.approx(np.full(4, 1.05), abs=1e-6) and found.weight.max() == 2
    assert fuse(wall(1.0, 1.1), [1], AHEAD).points()[:, 2] == pytest.approx(np.full(4, 1.1), abs=1e-6)
    assert not fuse(wall(0.0), [0], AHEAD).weight.any()
    found = Map.empty(AHEAD)
    for depth_m in (1.0, 1.0, 1.1):
        found.add(wall(depth_m).depth(0), CAMERA, np.eye(4), most_weight=1.0)
    assert found.points()[:, 2] == pytest.approx(np.full(4, 1.05), abs=1e-6)


def slow_integrate(into: Map, grid: VoxelGrid, depth: Depth, camera: Camera, pose: np.ndarray) -> None:
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
        w = into.weight[index]
        into.tsdf[index] = (into.tsdf[index] * w + min(1.0, (measured - z) / grid.truncation_m)) / (w + 1)
        into.weight[index] = w + 1


@pytest.mark.parametrize("seed", range(2))
def test_the_kernels_do_what_their_references_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.linalg.det(pose[:3, :3])
    pose[:3, 3] = rng.normal(size=3) * 0.3
    depth = rng.uniform(0.2, 1.5, (6, 8)).astype(np.float32)
    grid = VoxelGrid((-0.8, -0.8, -0.8), (9, 8, 7), 0.2)
    found, slow = Map.empty(grid), Map.empty(grid)
    for _ in range(2):
        found.add(depth, CAMERA, pose)
        slow_integrate(slow, grid, depth, CAMERA, pose)
    assert found.weight.any()
    assert found.weight.tolist() == slow.weight.tolist()
    assert found.tsdf == pytest.approx(slow.tsdf, abs=1e-5)


def test_the_error_of_a_shifted_plane() -> None:
    """A wall 2 cm off is 2 cm off both ways and covered; 6 cm off it is uncovered."""
    reference = fuse(wall(1.0), [0], AHEAD)
    near, far = (map_error(fuse(wall(1.0 + shift_m), [0], AHEAD), reference) for shift_m in (0.02, 0.06))
    assert (near.to_reference_m, near.from_reference_m, near.rmse_m) == pytest.approx((0.02,) * 3, abs=1e-5)
    assert far.rmse_m == pytest.approx(0.06, abs=1e-5)
    assert (near.uncovered, far.uncovered) == (0, 1) and COVERED_M < 0.06
    # Half the wall was never seen: nothing that is there is wrong.
    grid = VoxelGrid((-0.5, -0.2, 0.4), (11, 5, 12), 0.1)
    half = wall(1.0)
    half.depth(0)[:, 4:] = 0
    found = map_error(fuse(half, [0], grid), fuse(wall(1.0), [0], grid))
    # Pixels 0 to 3 see x < 0; of the points at 0 to 0.5 m each is as far away as it lies from that at -0.1 m.
    assert (found.to_reference_m, found.uncovered) == (0, pytest.approx(6 / 11))
    assert found.from_reference_m == pytest.approx(np.sqrt((0.01 + 0.04 + 0.09 + 0.16 + 0.25 + 0.36) / 11), abs=1e-6)


test_errors = refused(
    (lambda: VoxelGrid((0.0, 0.0, 0.0), (1000, 1000, 1000)), "grid of 1000 x 1000 x 1000 voxels"),
    (lambda: grid_of(wall(0.0)), "held: no frame holds a depth"),
    (lambda: map_error(Map.empty(AHEAD), fuse(wall(1.0), [0], AHEAD)), "the map holds no surface"),
)

"""Tracking: a known movement is found again, a gap that is too long is a failure, and its kernels as worked by hand."""

import frame_cases
import numpy as np
import pytest
from refusal_cases import refuse

from bufgym.papers.perception import icp, tracking
from bufgym.papers.perception.frames import Camera
from bufgym.papers.perception.mapping import Map, VoxelGrid, fuse
from bufgym.papers.perception.room import MadeUpRoom, made_up_room
from bufgym.papers.perception.tracking import Tracker, difference, smoothed, track
from bufgym.papers.perception.tsdf import raycast

CAMERA = Camera(8, 6, 4.0, 4.0, 3.5, 2.5)
NOWHERE = np.zeros((6, 8), np.float32)


def plane(z: float) -> np.ndarray:
    """The points of a wall at z as the camera sees them, float32[6, 8, 3]."""
    return icp.unproject(np.full((6, 8), z, np.float32), 10.0, CAMERA.lens)


@pytest.mark.kernels
def test_unprojected_points_and_their_normals() -> None:
    points, normals = plane(2.0), np.zeros((6, 8, 3), np.float32)
    assert points[0, 0].tolist() == [-1.75, -1.25, 2.0]
    icp.orient(points, np.zeros(3), 0.3, normals)
    assert normals[1:5, 1:7].reshape(-1, 3) == pytest.approx(np.tile([0, 0, -1.0], (24, 1)))
    points[:, 4:, 2] = 9.0  # another wall behind
    icp.orient(points, np.zeros(3), 0.3, normals)
    assert np.isnan(normals[0]).all() and np.isnan(normals[1:5, 3:5]).all() and not np.isnan(normals[1:5, 1:3]).any()
    assert np.isnan(icp.unproject(NOWHERE, 10.0, CAMERA.lens)).all()
    # Smoothing stays on one surface.
    depth = np.array([[1.0, 1.02, 3.0], [1.0, 0.0, 3.0]], np.float32)
    icp.smooth(depth, 1, 0.05, even := np.zeros_like(depth))
    assert even == pytest.approx(np.array([[3.02 / 3, 3.02 / 3, 3.0], [3.02 / 3, 0.0, 3.0]]), rel=1e-6)


@pytest.mark.kernels
def test_the_normal_equations_of_a_wall_that_is_five_centimetres_off() -> None:
    """All 24 points with a normal have a pair; moving back by 5 cm along z brings all into the plane."""
    model, points = plane(2.0), plane(2.05)
    normals = np.zeros((2, 6, 8, 3), np.float32)
    for vertices, result in zip((points, model), normals, strict=True):
        icp.orient(vertices, np.zeros(3), 0.5, result)
    sums = np.zeros((8, 8))
    pose = np.eye(4)
    arguments = (points, normals[0], 1, pose, model, normals[1], pose, CAMERA.lens)
    # Seen through the same pixel the pairs at the corner are 5 cm x (1, 2.5 / 4, 1.5 / 4) apart, 6.1 cm.
    assert icp.normal_equations(*arguments, 0.07, 0.9, np.zeros(8), sums) == 24
    assert sums[7, 7] == 24
    assert sums[6, 6] == pytest.approx(24 * 0.05**2, rel=1e-5)
    assert -sums[5, 6] / sums[5, 5] == pytest.approx(-0.05, rel=1e-5)
    assert (sums == sums.T).all()
    icp.normal_equations(*arguments, 0.04, 0.9, np.zeros(8), sums)
    assert sums[7, 7] == 0


def test_the_model_is_seen_where_it_is() -> None:
    """A wall at 1 m, fused, then looked at from 20 cm behind; with and without a hint where it is."""
    sequence = frame_cases.Held(CAMERA, [np.full((6, 8), 1.0, np.float32)], [np.eye(4)])
    grid = VoxelGrid((-1.2, -0.9, 0.0), (49, 37, 28), 0.05)
    found = fuse(sequence, [0], grid)
    behind = np.eye(4)
    behind[2, 3] = -0.2
    for hint in (NOWHERE, np.full((6, 8), 1.2, np.float32)):
        vertices = np.zeros((6, 8, 3), np.float32)
        place = (np.array(grid.origin_m), grid.voxel_m, grid.truncation_m, 4.0, CAMERA.lens, behind)
        raycast(found.tsdf, found.weight, *place, hint, vertices)
        assert vertices[1:5, 1:7, 2] == pytest.approx(np.ones((4, 6)), abs=1e-3)
        assert vertices[2, 3, 0] == pytest.approx(-0.5 / 4 * 1.2, abs=1e-3)


def test_a_known_movement_is_found_again() -> None:
    """3 cm to the right, 2 cm down, 1 cm ahead, and a turn of 1.5 degrees: found within 6 mm and 0.3 degrees."""
    still, angle, moved = made_up_room(0, frames=2), np.radians(1.5), np.eye(4)
    moved[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    moved[:3, 3] = 0.03, 0.02, 0.01
    poses = np.stack([still.poses[0], still.poses[0] @ moved])
    sequence = MadeUpRoom("moved", still.scene, still.time_us, poses, 0, stride=4)
    depths = [sequence.rendered(k, noisy=False)[0] for k in range(2)]
    tracker = Tracker(sequence.camera, VoxelGrid((-0.2, -0.2, -0.2), (136, 116, 76)))
    tracker.add(depths[0], poses[0])
    pose = tracker.follow(depths[1])
    assert pose is not None
    off_m, off_deg = difference(pose, poses[1])
    assert off_m < 0.006 and off_deg < 0.3
    assert difference(np.eye(4), frame_cases.TURNED) == pytest.approx((0.5, 90.0))


def test_it_follows_every_frame_and_fails_at_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = made_up_room(0, frames=80).reduced(4).loaded()
    whole = track(sequence, range(80), smooth=lambda k: smoothed(sequence.depth(k)))  # as it does itself
    assert not whole.failed and whole.where is None
    assert max(difference(*both)[0] for both in zip(whole.poses, sequence.poses, strict=True)) < 0.05
    torn = track(sequence, [*range(20), *range(60, 80)])
    assert torn.failed and torn.where == 60
    assert torn.poses[:20].tolist() == whole.poses[:20].tolist()
    assert np.isnan(torn.poses[20:]).all()
    # The recording claims a jump that its frames do not show.
    told = frame_cases.Held(sequence.camera, [sequence.depth(k) for k in range(6)], list(sequence.poses[:6]))
    told.poses[4:, 0, 3] += 0.2
    assert track(told, range(6)).where == 4
    monkeypatch.setattr(tracking, "MOST_ERROR_M", 0.3)
    assert track(told, range(6)).where is None
    for frames in ([], [3, 2], [2, 2], [-1, 1], [1, 80]):
        refuse("at least one index below 80, increasing", track, sequence, frames)


@pytest.mark.kernels
def test_a_single_wall_leaves_the_way_along_it_open(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = VoxelGrid((-1.2, -0.9, 0.0), (49, 37, 28), 0.05)
    monkeypatch.setattr(tracking, "APART_M", 10.0)
    monkeypatch.setattr(tracking, "LEAST_PAIRS", 0.0)
    tracker = Tracker(CAMERA, grid)
    tracker.add(NOWHERE, np.eye(4))
    assert tracker.follow(np.full((6, 8), 1.0, np.float32)) is None
    assert (tracker.model.weight == Map.empty(grid).weight).all()

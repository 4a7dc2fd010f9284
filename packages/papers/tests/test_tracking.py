"""Tracking: a known movement is found again, its kernels by hand, views that frames share; the made-up room by hand."""

import frame_cases
import numpy as np
import pytest
from needs import needs
from refusal_cases import refuse

from bufgym import scenario, sim
from bufgym.policies import get
from bufgym.scenario.numbered import draw
from bufgym.traces import Trace
from bufgym_papers.perception import icp, rays, streams, tracking
from bufgym_papers.perception.frames import Camera
from bufgym_papers.perception.mapping import Map, VoxelGrid, fuse
from bufgym_papers.perception.orb import OrbSimilarity, decision_ms, orbbuf_by
from bufgym_papers.perception.rays import BASELINE_M
from bufgym_papers.perception.room import FREE_M, Furniture, MadeUpRoom, made_up_room
from bufgym_papers.perception.tracking import Tracker, difference, smoothed, track
from bufgym_papers.perception.tsdf import raycast
from bufgym_papers.perception.views import Coverage, seen_shares

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
    wrong = frame_cases.Held(sequence.camera, [sequence.depth(k) for k in range(6)], list(sequence.poses[:6]))
    wrong.poses[4:, 0, 3] += 0.2
    assert track(wrong, range(6)).where == 4
    monkeypatch.setattr(tracking, "MOST_ERROR_M", 0.3)
    assert track(wrong, range(6)).where is None
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


# Frames sent over a link, what arrives, how much of it is new, and which frames images call similar.

TRACE = Trace.steps([(1, 100.0), (1, 50.0), (2, 10.0)], name="falling")


def wall(*right_m: float) -> frame_cases.Held:
    """A wall 2 m ahead of a camera that looks along z and moves to the right; a pixel is 10 cm wide there."""
    poses = np.tile(np.eye(4), (len(right_m), 1, 1))
    poses[:, 0, 3] = right_m
    depths = [np.full((30, 40), 2.0, np.float32) for _ in right_m]
    return frame_cases.Held(Camera(40, 30, 20.0, 20.0, 19.5, 14.5), depths, list(poses))


def test_sizes_first_frames_and_fades() -> None:
    assert streams.sizes(wall(*[0.0] * 14)).tolist() == [1000 * k for k in range(1, 15)]
    part = wall(0, 1, 2).first(2)
    assert (len(part), part.poses[1, 0, 3], part.depth(1)[0, 0], part.size_bytes(1)) == (2, 1, 2, 2000)
    whole = wall(0, 1)
    assert whole.first(5) is whole
    # Two seconds carry 150 bytes wherever they begin; what comes after them is the two seconds again.
    for offset_us, first in ((0, 100), (1_000_000, 50), (2_000_000, 100)):
        link = streams.fading(2_000_000, TRACE, offset_us)
        assert np.diff([link.carried_at(1_000_000 * t) for t in range(4)]).tolist() == [first, 150 - first, first]
    longer = streams.fading(9_000_000, TRACE)  # than the trace, which it meets again
    assert longer.carried_at(4_000_000) == 170 and longer.carried_at(8_000_000) == 340


def test_shares_of_a_view_that_were_seen_before() -> None:
    """1 m to the right is 10 of 40 pixels, a quarter of the view; 5 m leave nothing in common."""
    seen = seen_shares(wall(0, 1, 5))
    assert (seen[0, 1], seen[0, 2], seen[1, 0]) == (0.75, 0, 0)  # only what came after
    assert seen.diagonal().tolist() == [1, 1, 1]
    holed = wall(0, 0)
    holed.depth(0)[:, :20] = 0  # frame 0 measured nothing on its left half: a hole tells nothing
    assert seen_shares(holed)[0, 1] == 1
    holed.depth(0)[:, :20] = 1.5  # something stood before the wall there
    assert seen_shares(holed)[0, 1] == 0.5
    holed.depth(0)[:] = 0
    assert seen_shares(holed)[0, 1] == 0
    turned = wall(0, 0)
    turned.poses[1, :3, :3] = np.diag([-1, 1, -1])
    assert seen_shares(turned)[0, 1] == 0


def test_coverage_counts_what_is_new() -> None:
    # Frame 0 and its return see 40 columns of the wall, frame 1 the 10 beyond them, and 30 of the 40.
    coverage = Coverage(wall(0, 1, 0), least_views=1)
    assert coverage.cells == 50 * 30
    assert coverage.share([0]) == coverage.share([1]) == coverage.share([0, 2]) == 0.8
    assert (coverage.share([0, 1]), coverage.share([2, 1, 0]), coverage.share([])) == (1, 1, 0)
    assert Coverage(wall(0, 1, 0), least_views=2).cells == 40 * 30
    refuse(r"held: no cell of 0\.1 m was seen by 3 of its frames", Coverage, wall(0, 0))


@pytest.mark.kernels
def test_with_motion_for_images_it_decides_as_orbbuf() -> None:
    uplink = scenario.get("lte", duration_s=2.0)
    episode = draw(uplink, 3)
    x = episode.arrivals["x"]
    similar = orbbuf_by(lambda i, j: 1 - uplink.value(float(x[j] - x[i])), episode)
    for L in (1, 3, 8):
        ran = [sim.run(policy, [episode], L, uplink.value).batch.log[0] for policy in (similar, get("orbbuf"))]
        kept = [np.asarray(log)["dropped_us"].tolist() for log in ran]
        assert kept[0] == kept[1] and max(kept[0]) >= 0


def test_images_are_like_themselves_less_like_what_moved_and_hardly_like_others() -> None:
    pytest.importorskip("cv2", reason=needs("extras", "cv2"))
    from bufgym_papers.perception.room import made_up_room

    # Squares of noise, which have corners.
    noise = np.random.default_rng(0).integers(0, 255, (2, 30, 40), np.uint8).repeat(8, 1).repeat(8, 2)
    first = noise[0]
    similar = OrbSimilarity([first, np.roll(first, 80, axis=1), noise[1], np.zeros_like(first), first].__getitem__)
    assert similar(0, 4) > 0.95
    assert 0.3 < similar(0, 1) < similar(0, 4)
    assert similar(0, 2) < 0.3
    assert similar(0, 3) == similar(3, 0) == 0  # no features, no likeness
    assert similar(1, 0) == similar(0, 1)
    assert (decision_ms(made_up_room(0, frames=5).reduced(4), 2) > 0).all()


# In the middle of a room of 6 x 4 x 2 m, looking along +x: z of the camera is the world's x, x its -y, y its -z.
LOOKING = np.array([[0.0, 0, 1, 3], [-1, 0, 0, 2], [0, -1, 0, 1], [0, 0, 0, 1]])
EMPTY = [[3.0, 2, 1, 3, 2, 1, 1, 0]]
SMALL = 20
"""32 x 24 pixels."""


def scene(*things: list[float], balls: int | None = None, stride: int = SMALL) -> MadeUpRoom:
    all_things = np.array(EMPTY + list(things))
    where = Furniture(all_things, len(all_things) if balls is None else balls)
    return MadeUpRoom("test", where, np.array([0], np.int64), LOOKING[None], 3, stride)


def test_a_wall_ahead_is_three_metres_away_in_every_pixel() -> None:
    """z is measured along the axis, not along the ray; above and below the ceiling and floor come nearer."""
    depth = scene().rendered(0, noisy=False)[0]
    assert depth[8:17] == pytest.approx(np.full((9, 32), 3.0))
    # The topmost row looks up by 240 / 585: the ceiling, 1 m above, is 585 / 240 = 2.4375 m away.
    assert depth[0] == pytest.approx(np.full(32, 2.4375))
    # A ball's nearest point is its radius before its centre; a box turned by 45 degrees shows its edge.
    ball, turn = scene([4.5, 2, 1, 0.25, 0, 0, 0, 0], balls=1), np.pi / 4
    assert ball.rendered(0, noisy=False)[0][12, 16] == pytest.approx(1.25)
    box = scene([4.5, 2, 1, 0.5, 0.5, 0.5, np.cos(turn), np.sin(turn)])
    assert box.rendered(0, noisy=False)[0][12, 16] == pytest.approx(1.5 - np.sqrt(0.5))


def test_a_kinects_depth_has_steps_and_shadows() -> None:
    """585 px x 7.5 cm = 43.875 m px: at 3 m a disparity of 14.625 px = 117 steps, so 118 steps are 2.975 m."""
    middle = scene().depth(0)[8:17]
    steps = 8 * 585 * BASELINE_M / middle
    assert np.rint(steps) == pytest.approx(steps, abs=0.03)  # whole mm
    assert {115, 116, 117, 118, 119} >= set(np.rint(steps).astype(int).ravel()) >= {116, 117, 118}
    assert middle.std() == pytest.approx(0.5 * 3.0 / 117, rel=0.5)
    # Behind a box at 1.5 m a wall at 3 m has a shadow of f b (1/1.5 - 1/3) = 14.6 px on the camera's left.
    row = scene([4.55, 2, 1, 0.05, 0.3, 0.3, 1, 0], stride=1).depth(0)[240]
    missing = np.flatnonzero(row == 0)
    # The box's left edge is at 320 - 585 * 0.3 / 1.5 = 203.
    assert [missing.min(), missing.max()] == pytest.approx([203 - 14.6, 202], abs=1.1)
    assert len(missing) == missing.max() - missing.min() + 1


def test_a_seed_gives_the_same_frames_and_another_seed_others() -> None:
    first, again, other = (made_up_room(seed, frames=3).reduced(SMALL) for seed in (7, 7, 8))
    for k in (2, 0):
        assert (first.depth(k) == again.depth(k)).all() and (first.grey(k) == again.grey(k)).all()
    assert first.depth(0).tobytes() != other.depth(0).tobytes()
    assert first.depth(0).tobytes() != first.depth(1).tobytes()  # noise is drawn for every frame
    whole, half = first, first.reduced(2)
    assert (half.depth(1) == whole.depth(1)[::2, ::2]).all() and (half.grey(1) == whole.grey(1)[::2, ::2]).all()


def test_what_is_seen_is_the_same_without_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Things are looked for within their bounds alone: every thing for every pixel finds nothing else."""
    views = [(made_up_room(seed).reduced(40), k) for seed in range(2) for k in range(0, 794, 120)]
    bounded = [made.rendered(k) for made, k in views]

    monkeypatch.setattr(rays, "bounds", lambda things, *camera: np.tile(rays.ANYWHERE, (len(things), 1)))
    for (made, k), (depth, grey) in zip(views, bounded, strict=True):
        everything = made.rendered(k)
        assert (depth == everything[0]).all() and (grey == everything[1]).all()


def test_no_thing_stands_in_the_cameras_way() -> None:
    made = made_up_room(1)
    place = made.poses[:, :3, 3]
    assert len(made) == 794
    for box in made.scene.things[1 : made.scene.balls]:
        turned = (place - box[:3]) @ np.array([[box[6], -box[7], 0], [box[7], box[6], 0], [0, 0, 1]])
        assert (np.abs(turned) > box[3:6] + 0.5 * FREE_M).any(axis=1).all()
    rotation = made.poses[:, :3, :3]
    assert rotation @ rotation.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (794, 1, 1)))
    assert np.linalg.det(rotation) == pytest.approx(np.ones(794))


def test_what_is_not_there_is_refused() -> None:
    refuse("frames = 1: must be at least 2", made_up_room, 0, frames=1)
    refuse("frame 2: must be from 0 to 1", made_up_room(0, frames=2).reduced(SMALL).depth, 2)

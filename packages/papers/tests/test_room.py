"""The made-up room: depths worked by hand, a Kinect's steps and shadows, and the same frames for the same seed."""

import frame_cases  # noqa: F401  skips where the extra is absent
import numpy as np
import pytest
from refusal_cases import refuse

from bufgym_papers.perception import rays
from bufgym_papers.perception.rays import BASELINE_M
from bufgym_papers.perception.room import FREE_M, Furniture, MadeUpRoom, made_up_room

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

"""Frames sent over a link, what arrives, how much of it is new, and which frames images call similar."""

import frame_cases
import numpy as np
import pytest
from refusal_cases import refuse

from bufgym import scenario, sim
from bufgym.papers.perception import streams
from bufgym.papers.perception.frames import Camera
from bufgym.papers.perception.orb import OrbSimilarity, decision_ms, orbbuf_by
from bufgym.papers.perception.views import Coverage, overlap_information, seen_shares
from bufgym.policies import get
from bufgym.scenario.numbered import draw
from bufgym.traces import Trace

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


def test_information_and_coverage_count_what_is_new() -> None:
    seen = seen_shares(wall(0, 1, 0))
    # A quarter there, and another back.
    assert [overlap_information(seen, kept) for kept in ([], [1], [0, 1, 2], [0, 2])] == [0, 1, 1.5, 1]
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
    pytest.importorskip("cv2")
    from bufgym.papers.perception.room import made_up_room

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

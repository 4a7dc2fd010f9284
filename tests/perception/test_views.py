"""Overlap of views and coverage, on a wall where both can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest
from view_cases import Wall

from bufgym.errors import BufgymError
from bufgym.perception.views import Coverage, overlap_information, seen_shares


def test_a_step_of_a_quarter_of_the_view_shows_a_quarter_that_is_new() -> None:
    """1 m to the right is 10 of 40 pixels."""
    seen = seen_shares(Wall([0, 1, 5]))
    assert seen[0, 1] == 0.75
    assert seen[0, 2] == 0  # 5 m: nothing in common
    assert seen.diagonal().tolist() == [1, 1, 1] and seen[1, 0] == 0  # only what came after


def test_what_lies_elsewhere_was_not_seen_and_a_hole_tells_nothing() -> None:
    wall = Wall([0, 0])
    wall.depths[0, :, :20] = 0  # frame 0 measured nothing on its left half
    assert seen_shares(wall)[0, 1] == 1
    wall.depths[0, :, :20] = 1.5  # something stood before the wall there
    assert seen_shares(wall)[0, 1] == 0.5
    wall.depths[0] = 0
    assert seen_shares(wall)[0, 1] == 0


def test_a_camera_that_has_turned_round_has_seen_nothing_of_it() -> None:
    wall = Wall([0, 0])
    wall.poses[1, :3, :3] = np.diag([-1, 1, -1])
    assert seen_shares(wall)[0, 1] == 0


def test_information_by_overlap_counts_what_is_new_since_the_frame_before() -> None:
    seen = seen_shares(Wall([0, 1, 0]))
    assert overlap_information(seen, []) == 0
    assert overlap_information(seen, [1]) == 1
    assert overlap_information(seen, [0, 1, 2]) == 1.5  # a quarter there, and another back
    assert overlap_information(seen, [0, 2]) == 1


def test_coverage_counts_each_place_once() -> None:
    """Frame 0 and its return see 40 columns of the wall, frame 1 the 10 beyond them, and 30 of the 40."""
    coverage = Coverage(Wall([0, 1, 0]), least_views=1)
    assert coverage.cells == 50 * 30
    assert coverage.share([0]) == coverage.share([1]) == coverage.share([0, 2]) == 0.8
    assert coverage.share([0, 1]) == coverage.share([2, 1, 0]) == 1
    assert coverage.share([]) == 0


def test_what_too_few_frames_saw_does_not_count() -> None:
    assert Coverage(Wall([0, 1, 0]), least_views=2).cells == 40 * 30
    with pytest.raises(BufgymError, match=r"wall: no cell of 0\.1 m was seen by 3 of its frames"):
        Coverage(Wall([0, 0]))

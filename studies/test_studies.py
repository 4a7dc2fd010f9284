"""The studies' own numbers by hand: gaps under Random, a queue that is full, frames kept, rules on measured views."""

from pathlib import Path

import numpy as np
import pytest

from bufgym.sim import NEVER
from bufgym.traces import Trace, write_csv
from bufgym_papers.figures import figure
from studies import afr_overlap, afr_qoi_task, afr_vs_random
from studies.afr_frame_size import full


def all_outcomes(L: int, T: int) -> dict[tuple[int, ...], float]:
    """Messages kept by Random -> probability, by trying every drop."""
    outcomes = {tuple(range(1, min(L, T) + 1)): 1.0}
    for t in range(L + 1, T + 1):
        grown: dict[tuple[int, ...], float] = {}
        for kept, probability in outcomes.items():
            candidates = (*kept, t)
            for k in range(L + 1):
                left = candidates[:k] + candidates[k + 1 :]
                grown[left] = grown.get(left, 0.0) + probability / (L + 1)
        outcomes = grown
    return outcomes


@pytest.mark.parametrize(("L", "T"), [(1, 1), (1, 4), (2, 5), (3, 8), (4, 3)])
def test_expected_gaps_are_those_of_every_outcome(L: int, T: int) -> None:
    counts = np.zeros(14)
    for kept, probability in all_outcomes(L, T).items():
        for gap in np.diff((0, *kept, T + 1)):
            counts[gap] += probability
    assert afr_vs_random.expected_gaps(L, 12)[T] == pytest.approx(counts, abs=1e-12)
    sums, lengths = afr_vs_random.expected_gaps(8, 60), np.arange(1, 61)
    assert sums.sum(axis=1)[1:] == pytest.approx(np.minimum(lengths, 8) + 1)
    assert (sums @ np.arange(62))[1:] == pytest.approx(lengths + 1)


def test_the_share_of_the_time_in_which_a_queue_is_full() -> None:
    """L = 2: messages come at 0, 1 and 3 s, the second leaves at 1.5 s, the first is dropped at 2 s: two for .5 s."""
    kinds = [("dropped_us", np.int64), ("dequeued_us", np.int64)]
    log = np.array([(2_000_000, NEVER), (NEVER, 1_500_000), (NEVER, NEVER)], kinds)
    assert full(log, np.array([0.0, 1.0, 3.0]), 2) == pytest.approx(0.5 / 3)


def test_frames_kept_are_counted_by_the_second_of_their_arrival(tmp_path: Path) -> None:
    path = tmp_path / "wide.csv"
    write_csv(Trace.constant(1e8, 30.0, name="wide"), path)
    rows = figure("afr-frame-size", trace=str(path), frames=750, capacities=(5,), runs=1, sweep_kb=(300,)).simulate()
    assert set(rows.column("dropped")) == {0}
    kept = {(row["policy"], s): row[f"kept_in_second_{s}"] for row in rows for s in (21, 23)}
    assert kept == {name: pytest.approx(30, abs=1) for name in kept}


def test_the_best_frames_in_hindsight_and_rules_at_a_distance() -> None:
    # Four frames: 0 to 1 and 1 to 3 are new by 0.5 each, all else by 0.1; one frame between may be kept.
    v = np.full((4, 4), 0.1)
    v[0, 1] = v[1, 3] = 0.5
    assert afr_overlap.best_gain(v, 1) == 1.0
    assert afr_overlap.best_gain(v, 0) == pytest.approx(0.1)
    # V = 0, 0.1, 0.4, 0.3 at distance 0..3 from frame 0: from 1 to 2 it more than doubles.
    v = np.zeros((4, 4))
    v[0] = [0, 0.1, 0.4, 0.3]
    found = afr_overlap._rules(v, np.arange(4.0), 1)
    assert found is not None and found["broken_6"] == 0.5  # at frame 0; frame 1 sees nothing new
    assert found["excess_6"] == pytest.approx(0.2) and found["broken_5"] == 0
    assert afr_overlap._rules(v, np.arange(4.0), 2) is None  # 4 frames on is beyond the end


def test_information_by_overlap_is_what_is_new() -> None:
    """A quarter of frame 1 is new after frame 0, a quarter of frame 2 after frame 1, and nothing of it after 0."""
    seen = np.array([[1, 0.75, 1], [0, 1, 0.75], [0, 0, 1]], np.float32)
    assert [afr_overlap.overlap_information(seen, kept) for kept in ([], [1], [0, 1, 2], [0, 2])] == [0, 1, 1.5, 1]


def test_a_correlation_draws_whole_groups() -> None:
    """Within each group b falls with a; whichever groups are drawn, it is -1."""
    a, group = np.array([1.0, 2, 1, 2, 1, 2]), np.repeat([0, 1, 2], 2)
    assert afr_qoi_task.spearman_over(a, -a, group, "falls") == pytest.approx((-1, -1, -1))

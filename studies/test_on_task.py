"""Agents that are evolved by the robot's own task: episodes, rewards, and the table."""

import numpy as np
import pytest
from needs import needs

for extra in ("sb3_contrib", "cma", "cv2", "rvl"):
    pytest.importorskip(extra, reason=needs("extras", extra))

from bufgym import policies, sim  # noqa: E402
from bufgym.jit import JIT  # noqa: E402
from bufgym_papers.perception import streams, worth  # noqa: E402
from studies import on_task  # noqa: E402  (these need the extras)

pytestmark = pytest.mark.skipif(not JIT, reason=needs("compiled", "without compilation a room takes minutes to draw"))


def test_frames_arrive_as_they_do_one_episode_at_a_time() -> None:
    side_by_side = on_task.Episodes([(0, 3), (5, 4)], 4)
    arrived = side_by_side.arrived(policies.get("afr"))
    for episode, frames in zip(side_by_side.episodes, arrived, strict=True):
        assert frames.tolist() == list(streams.received("afr", episode, 4))
        sender = sim.run(policies.get("afr"), [episode], 4, worth.mapping().value).batch.senders[0]
        assert on_task.information(frames) == pytest.approx(float(sender["delivered_gain"]) + 1)
    assert arrived[0].tolist() != arrived[1].tolist()


def test_a_task_is_the_mean_of_its_reward() -> None:
    """Who sends all frames has seen all; training leaves the last two links alone."""
    task = on_task.Task("covered", 4, 0)
    episodes = task.training[0]
    covered = [worth.coverage_of(frames) for frames in episodes[0].arrived(policies.get("drop-oldest"))]
    assert task.measure(policies.get("drop-oldest"), episodes) == pytest.approx(np.mean(covered))
    assert task.fitness(policies.get("drop-oldest"), 0) == -task.measure(policies.get("drop-oldest"), episodes)
    trained_on = {each.link.trace.name for part in task.training for each in part[0].episodes}
    assert trained_on.isdisjoint({trace.name for trace in worth.mapping().traces[-on_task.TEST_LINKS :]})

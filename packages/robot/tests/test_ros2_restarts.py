"""``/*`` over thirty topics and a late one, and a receiver that is restarted five times beside a viewer."""

import json
from collections import Counter
from pathlib import Path

import pytest
from test_ros2 import REPO, in_ros, run

from bufgym_robot import read_log


@in_ros
@pytest.mark.nightly
def test_nothing_acked_is_lost_and_no_topic_is_left_out(tmp_path: Path) -> None:
    """The queue's log has what the receiver acked (n_T = 4); the viewer has at least as many of each topic.

    Both commands stay under 120 MB.
    """
    seen = json.loads(run(REPO / "packages/robot/tests/ros2_restarts_session.py", tmp_path).splitlines()[-1])
    log = read_log(tmp_path / "log.mcap")
    topic_of = {record["seq"]: record["topic"] for record in log if record["event"] == "put"}
    acked = Counter(topic_of[record["seq"]] for record in log if record["event"] == "gone")
    came = sorted(len(set(texts)) for texts in seen["came"].values())
    print(acked.total(), sum(came), seen["memory_mb"])
    assert len(acked) == len(came) == 31 and acked.total() > 500 and min(came) > 0
    assert all(got >= left for got, left in zip(came, sorted(acked.values()), strict=True))
    assert max(seen["memory_mb"]) < 120

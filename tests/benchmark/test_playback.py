"""What a policy delivers and drops of a recording, as a recording of its own."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_cases import Capsys, fails, shown
from needs import needs

pytest.importorskip("mcap", reason=needs("extras", "mcap"))
pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))

sys.path.append(str(Path(__file__).resolve().parents[1] / "traces"))
import bag_cases as cases

from bufgym.benchmark.playback import queue_lengths
from bufgym.sim.state import NEVER
from bufgym.traces import read_bag
from bufgym.traces.formats.bags import messages


def test_lengths_of_a_queue_by_hand() -> None:
    """Messages of 5, 7 and 9 bytes at 0, 10 and 10 us: one dequeued at 10, one rejected, one stays."""
    arrivals = np.array([(0, 5), (10, 7), (10, 9)], [("arrival_us", np.int64), ("size_bytes", np.int64)])
    log = np.array([(10, NEVER), (NEVER, 10), (NEVER, NEVER)], [("dequeued_us", np.int64), ("dropped_us", np.int64)])
    assert queue_lengths(arrivals, log).tolist() == [[0, 1, 5], [10, 1, 9]]


def test_what_a_policy_delivers_and_drops_as_a_recording(tmp_path: Path, capsys: Capsys) -> None:
    """40 messages of 1,000 letters, one each 10 ms, over 10 kB/s, with a buffer of 3: most are dropped."""
    out = tmp_path / "out.mcap"
    for name, write, store in (("a.mcap", cases.write_mcap, cases.ROS2), ("a.bag", cases.write_ros1, cases.ROS1)):
        entries = [(10 * k, "/t", "std_msgs/msg/String", cases.text(f"{k:04}" * 250, store)) for k in range(40)]
        path = write(tmp_path / name, entries)
        command = ["bench", "--workload", path, "--trace", "10kB/s", "--capacity", "3", "--policies", "drop-oldest,afr"]
        said = shown([*command, "--no-bound", "--mcap", out], capsys)
        original = [data for _, _, data in messages(read_bag(path))]
        assert f"wrote {out}, L = 3:" in said
        bag = read_bag(out)
        by_topic: dict[str, list[bytes]] = {}
        for channel, _, data in messages(bag):
            by_topic.setdefault(channel.topic, []).append(data)
        for policy in ("drop-oldest", "afr"):
            delivered, dropped = (by_topic[f"/{policy}/{what}/t"] for what in ("delivered", "dropped"))
            assert f"/{policy}/delivered/...: {len(delivered)}, /{policy}/dropped/...: {len(dropped)}," in said
            assert {*delivered, *dropped} <= {*original} and not {*delivered} & {*dropped}
            assert len(delivered) + len(dropped) >= 36 and len(dropped) > 20
            lengths = [json.loads(data)["length"] for data in by_topic[f"/{policy}/queue"]]
            assert max(lengths) == 3 and min(lengths) >= 0
        assert bag.topics["/afr/delivered/t"] == "std_msgs/msg/String"


def test_what_a_playback_needs(tmp_path: Path, capsys: Capsys) -> None:
    table = tmp_path / "a.csv"
    table.write_text("time_s,bytes\n0,1000\n1,1000\n")
    command = ["bench", "--trace", "10kB/s", "--policies", "afr", "--no-bound"]
    played = [*command, "--workload", table, "--mcap"]
    fails([*played, tmp_path / "o.mcap"], "needs a recording that holds the messages themselves", capsys)
    fails([*played, tmp_path / "o.csv"], "must be FILE.mcap, and needs --workload", capsys)
    fails([*command, "--mcap", tmp_path / "o.mcap"], "must be FILE.mcap, and needs --workload", capsys)
    assert not list(tmp_path.glob("o.*"))

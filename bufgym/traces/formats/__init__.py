"""Files in and out: bandwidth traces, camera trajectories, motion, workloads and robots' recordings.

| module | what it reads or writes |
|---|---|
| `links` | bandwidth traces in any format: `read_trace`, by the readers in `mahimahi`, `tables` and `logs` |
| `writers` | bandwidth traces as CSV or Mahimahi |
| `trajectories`, `motions` | camera poses (TUM, EuRoC, KITTI), and the motion that they make |
| `workloads` | messages as CSV |
| `bags`, `bag_poses`, `recordings` | robots' recordings, and the workloads that they make |

`text` opens every text file safely, `faults` makes the error messages, and `intervals` collects
measurements that follow each other.
"""

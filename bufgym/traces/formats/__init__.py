"""Files in and out: bandwidth traces, camera trajectories, motion, workloads and robots' recordings.

`text` opens every text file safely, `faults` makes the error messages, and `intervals` collects
measurements that follow each other.
"""

"""Files in and out: bandwidth traces, camera trajectories, motion, workloads and robots' recordings.

`text` opens text files safely, `faults` makes errors, `intervals` collects measurements that follow each other.
"""

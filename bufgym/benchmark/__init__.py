"""Comparison of policies on the same episodes, which ``bufgym.compare`` starts: sweeps over suites, scores, reports.

``drops``, ``leaderboard`` and ``report`` are modules.
"""

from typing import TYPE_CHECKING

from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym.benchmark import drops, leaderboard, report
    from bufgym.benchmark.rows import read_rows, write_rows
    from bufgym.benchmark.sweep import Sweep, run_sweep
    from bufgym.benchmark.tasks import TASKS

__all__ = ["TASKS", "Sweep", "drops", "leaderboard", "read_rows", "report", "run_sweep", "write_rows"]

__getattr__ = on_demand(__name__, {
    "drops": "drops", "leaderboard": "leaderboard", "report": "report", "read_rows": "rows", "write_rows": "rows",
    "Sweep": "sweep", "run_sweep": "sweep", "TASKS": "tasks",
})  # fmt: skip

"""One library's training on a budget of processor time, scored on the way.

python -m studies.budget --library tianshou --reward regret --minutes 1 2 5 10 --lines runs/ten_minutes.csv

The minutes are processor time of the process and all those below it, so other work on the machine does not matter.
Imports, preparations and evaluations do not count. At the first step of an environment after each of the minutes, the
score is appended to the file, and training goes on; after the last it is cut. So an update is never cut in two, and
``cpu_s`` in the file has the time that it was. The score is computed as in ``studies.sb3_defaults``,
which needs the extras ``train`` and ``plot`` beside the library and psutil.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before any library is imported

import contextlib
import math
import random
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from types import TracebackType

import numpy as np
import psutil
import torch

from bufgym.utils.errors import BufgymError, unknown
from studies.libraries import LIBRARIES, Task
from studies.page import command
from studies.sb3_defaults import Episodes, append

MINUTES = (1.0, 2.0, 5.0, 10.0)
CHECK_S = 0.2
"""Processor time between two checks, s."""
LINE = ("library", "version", "reward", "seed", "minutes", "cpu_s", "score", "why")
"""Columns of the file: a score, or why there is none."""


class TimeIsUp(BaseException):
    """The processor time is used up; no ``Exception``, so that no library catches it."""


class Budget:
    """A block that is looked at after each of the minutes of processor time, and ends after the last.

    Args:
        minutes: of this process and those below it, ascending.
        look: called with the minutes that are due and the processor time so far, s; its own time does not count.
    """

    def __init__(self, minutes: Sequence[float], look: Callable[[float, float], None]) -> None:
        self._due, self._look = list(minutes), look
        self._began_s, self._next_s = 0.0, math.inf

    def __enter__(self) -> None:
        self._began_s, self._next_s = _processor_s(), 0.0

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> bool:
        self._next_s = math.inf
        if kind is None and self._due:
            self._look(self._due[-1], _processor_s() - self._began_s)  # trained by a schedule, to its end
        return kind is TimeIsUp

    def check(self) -> None:
        """Look if it is time: for each step of an environment, where a library's own state is whole."""
        if time.process_time() < self._next_s:
            return
        spent_s = _processor_s() - self._began_s
        if spent_s >= 60 * self._due[0]:
            reached = [m for m in self._due if spent_s >= 60 * m]  # two, if an update took long
            self._due = self._due[len(reached) :]
            self._look(reached[-1], spent_s)
            self._began_s = _processor_s() - spent_s
        if not self._due:
            raise TimeIsUp
        self._next_s = time.process_time() + CHECK_S


def _processor_s() -> float:
    """Seconds of this process and all below it, ended ones too."""
    root, spent_s = psutil.Process(), 0.0
    for process in (root, *root.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):  # it ended just now
            spent_s += sum(process.cpu_times()[:4])
    return spent_s


def page(
    library: str,
    reward: str = "regret",
    seed: int = 0,
    minutes: Sequence[float] = MINUTES,
    lines: Path = Path("runs/ten_minutes.csv"),
    episodes: int = 40,
) -> None:
    """Train with one library, and append its scores to the file of lines."""
    if library not in LIBRARIES:
        raise unknown("library", library, LIBRARIES)
    if not minutes or list(minutes) != sorted({m for m in minutes if m > 0}):
        raise BufgymError(f"minutes = {list(minutes)}: must be positive and ascend")
    random.seed(seed)
    np.random.seed(seed)  # some libraries draw from it
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    chosen, fixed = LIBRARIES[library], Episodes(episodes)

    def look(due: float, cpu_s: float) -> None:
        score = fixed.of_model(learner.policy())
        print(f"{library}, {reward}, seed {seed}: {score:.3f} after {cpu_s:.0f} s of processor time", flush=True)
        start = (library, version(chosen.distribution), reward, seed)
        append(lines, LINE, (*start, f"{due:g}", f"{cpu_s:.1f}", f"{score:.4f}", ""))

    lines.parent.mkdir(exist_ok=True)
    budget = Budget(minutes, look)
    learner = chosen.learner(Task(reward, seed, minutes[-1], budget.check))
    with budget:
        learner.train()


if __name__ == "__main__":
    command(page)

"""One library's training on a budget of processor time, scored on the way.

python -m studies.budget --library tianshou --reward regret --minutes 1 2 5 10 --lines runs/ten_minutes.csv

The minutes are processor time of the process and all those below it, so other work on the machine does not matter.
Imports, preparations and evaluations do not count. At each of the minutes training stops where it is, the score is
appended to the file, and training goes on; at the last it is cut. The score is computed as in ``studies.sb3_defaults``,
which needs the extras ``train`` and ``plot`` beside the library and psutil.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before any library is imported

import contextlib
import random
import signal
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from types import FrameType, TracebackType

import numpy as np
import psutil
import torch

from bufgym.utils.errors import BufgymError, unknown
from studies.libraries import LIBRARIES, Task
from studies.page import command
from studies.sb3_defaults import Episodes, append

MINUTES = (1.0, 2.0, 5.0, 10.0)
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
        self._began_s = 0.0

    def __enter__(self) -> None:
        self._began_s = _processor_s()
        signal.signal(signal.SIGPROF, self._check)
        self._watch()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> bool:
        signal.setitimer(signal.ITIMER_PROF, 0)
        if kind is None and self._due:
            self._look(self._due[-1], _processor_s() - self._began_s)  # trained by a schedule, to its end
        return kind is TimeIsUp

    def _watch(self) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.5, 0.5)  # again and again: a destructor swallows what is raised in it

    def _check(self, number: int, frame: FrameType | None) -> None:
        spent_s = _processor_s() - self._began_s
        if self._due and spent_s >= 60 * self._due[0]:
            signal.setitimer(signal.ITIMER_PROF, 0)
            self._look(self._due.pop(0), spent_s)
            self._began_s = _processor_s() - spent_s
            self._watch()
        if not self._due:
            raise TimeIsUp


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
    np.random.seed(seed)  # noqa: NPY002  (what libraries draw from)
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    chosen, fixed = LIBRARIES[library], Episodes(episodes)
    learner = chosen.learner(Task(reward, seed, minutes[-1]))

    def look(due: float, cpu_s: float) -> None:
        score = fixed.of_model(learner.policy())
        print(f"{library}, {reward}, seed {seed}: {score:.3f} after {cpu_s:.0f} s of processor time", flush=True)
        start = (library, version(chosen.distribution), reward, seed)
        append(lines, LINE, (*start, f"{due:g}", f"{cpu_s:.1f}", f"{score:.4f}", ""))

    lines.parent.mkdir(exist_ok=True)
    with Budget(minutes, look):
        learner.train()


if __name__ == "__main__":
    command(page)

"""A run's folder: its settings, one folder a seed with the seed's curves, and the results of each finished seed."""

import concurrent.futures
import csv
import json
import multiprocessing
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from agents.settings import RunSettings, Settings
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import locked, write_text
from bufgym.utils.processes import end_with

RUNS = Path("runs")
MODEL = "model.safetensors"
"""The file of an agent whose weights bufgym runs without torch."""
FREE = {"command", "name", "resume", "steps", "checkpoint_every", "validate_every", "episodes", "seeds"}
"""Settings that may differ between a run and its resumption."""

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Run:
    """One seed's finished training."""

    seed: int
    """The training seed."""
    folder: Path
    """Its folder, runs/NAME/seed-SEED."""
    seconds: float
    """Time spent training, over all its sessions, s."""
    curve: list[Numbers]
    """(steps, seconds, mean QoI of the latest training episodes), a row per update."""
    validation: list[Numbers]
    """(steps, seconds, measures), a row per validation; the last measure chooses the agent to keep."""
    best: Callable[..., Any] = min
    """``min`` or ``max``, the better direction of the last measure."""

    @property
    def model(self) -> Path:
        """The kept agent's file."""
        return self.folder / MODEL

    @property
    def reached(self) -> float:
        """The best measure on validation."""
        return float(self.best(row[-1] for row in self.validation))

    @property
    def merit(self) -> float:
        """The more the better: the best measure on validation."""
        return self.reached if self.best is max else -self.reached


def prepare(settings: RunSettings) -> Path:
    """The run's folder: made for a new run, checked against these settings for a resumed one."""
    folder = RUNS / (settings.name or _default_name(settings.resume))
    if settings.resume:
        if not (folder / "settings.json").exists():
            raise BufgymError(f"--resume: there is no run in {folder}")
    elif folder.exists() and any(not path.name.startswith(".") for path in folder.iterdir()):
        raise BufgymError(f"{folder} exists: choose another --name, or --resume it")
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        text = json.dumps({"command": settings.command, "algo": settings.algo, **settings.values}, indent=2) + "\n"
        values = json.loads(text)
        if settings.resume:
            before = read_settings(folder)
            changed = [name for name in values if name not in FREE and before.get(name) != values[name]]
            if changed:
                changes = ", ".join(f"{name} was {before.get(name)!r}, now {values[name]!r}" for name in changed)
                raise BufgymError(f"--resume: give the settings that the run in {folder} began with: {changes}")
        write_text(folder / "settings.json", text)
    return folder


def write_notes(
    folder: Path, settings: RunSettings, seeds: Sequence[int], scores: Mapping[str, Any] | None = None
) -> None:
    """Write notes.json, from which ``bufgym export`` describes the model in this folder."""
    notes: dict[str, Any] = {"training": settings.command, "seeds": list(seeds)}
    if scores:
        notes["scores"] = scores
    (folder / "notes.json").write_text(json.dumps(notes, indent=2) + "\n", encoding="utf-8")


def read_settings(folder: Path) -> dict[str, Any]:
    """The settings of the run in ``folder``, and its command."""
    file = folder / "settings.json"
    try:
        settings: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BufgymError(f"{file}: cannot be read: {error}") from None
    return settings


def _default_name(resume: bool) -> str:
    """The last of train-1, train-2, ... to resume, or the next."""
    numbers = [int(path.name[6:]) for path in RUNS.glob("train-*") if path.name[6:].isdigit()]
    return f"train-{max(numbers, default=0) + (0 if resume and numbers else 1)}"


def pool_of(workers: int) -> concurrent.futures.ProcessPoolExecutor:
    """A pool of so many processes, which end with this one. They are fresh: torch's threads do not survive a fork."""
    context = multiprocessing.get_context("spawn")
    return concurrent.futures.ProcessPoolExecutor(workers, context, end_with, (os.getpid(),))


def each_seed(train: Callable[[Path, int, int], Run], settings: Settings, folder: Path) -> list[Run]:
    """Call ``train`` (the run's folder, seed, line of its progress bar) for every seed, a process each."""
    seeds = range(settings.seed, settings.seed + settings.seeds)
    for seed in seeds:
        (folder / f"seed-{seed}").mkdir(exist_ok=True)
        write_notes(folder / f"seed-{seed}", settings, [seed])
    if len(seeds) == 1:
        return [train(folder, seeds[0], 0)]
    waiting = list(seeds)
    runs: dict[int, Run] = {}
    while waiting:
        with pool_of(min(len(waiting), os.cpu_count() or 1)) as pool:
            jobs = {seed: pool.submit(train, folder, seed, seed - seeds[0]) for seed in waiting}
            before = len(waiting)
            for seed, job in jobs.items():
                try:
                    runs[seed] = job.result()
                except BrokenProcessPool:
                    continue
                waiting.remove(seed)
        if len(waiting) == before:
            raise BufgymError("a seed's process ended before its training did (killed, or out of memory?); --resume it")
        if waiting:
            print(f"a seed's process ended before its training did: {len(waiting)} seeds go on", file=sys.stderr)
    return [runs[seed] for seed in seeds]


class Record:
    """Rows (steps, seconds, ...) in a CSV file that grows; a resumed run keeps the rows up to its checkpoint."""

    def __init__(self, path: Path, columns: tuple[str, ...], steps: int) -> None:
        self.path = path
        self.rows: list[Numbers] = []
        if path.exists():
            with path.open(newline="", encoding="utf-8") as file:
                rows = [tuple(float(row[name]) for name in columns) for row in csv.DictReader(file)]
            self.rows = [(int(row[0]), *row[1:]) for row in rows if row[0] <= steps]
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([columns, *self.rows])

    def append(self, *row: float) -> None:
        """Add a row, to the file as well."""
        self.rows.append(row)
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(row)


class Validations:
    """A seed's validations, ``validate_every`` steps apart, in validation.csv, and the best of them.

    Args:
        home: the seed's folder.
        columns: names of the measures; the last one chooses the agent to keep.
        best: ``min`` or ``max``, its better direction.
        steps: where training goes on from; later rows are left out.
    """

    def __init__(
        self, home: Path, columns: tuple[str, ...], best: Callable[..., Any], settings: RunSettings, steps: int
    ) -> None:
        self.settings, self.columns, self.choose = settings, columns, best
        self.record = Record(home / "validation.csv", ("steps", "seconds", *columns), steps)

    @property
    def rows(self) -> list[Numbers]:
        """(steps, seconds, *measures), a row per validation."""
        return self.record.rows

    @property
    def best(self) -> Numbers:
        """The best row; the earliest of several."""
        row: Numbers = self.choose(self.rows, key=lambda row: row[-1])
        return row

    def due(self, steps: int, last: bool = False) -> bool:
        """Whether a validation is due; at the beginning and at the end it always is. ``last`` is an early end."""
        if not self.rows:
            return True
        since = steps - self.rows[-1][0]
        return since >= self.settings.every or ((last or steps >= self.settings.steps) and since > 0)

    def add(self, steps: int, seconds: float, measures: Numbers) -> bool:
        """Add a validation; return whether it is the best so far."""
        self.record.append(steps, round(seconds, 3), *measures)
        return self.best is self.rows[-1]


def seed_bar(steps: int, done: int, seed: int, line: int) -> Any:
    """A seed's progress bar on line ``line``, on a terminal only."""
    return tqdm(
        total=steps,
        initial=done,
        desc=f"seed {seed}",
        unit=" steps",
        unit_scale=True,
        position=line,
        disable=not sys.stderr.isatty(),
    )

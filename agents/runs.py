"""A run's folder: its settings, one folder a seed with the seed's curves, and what each finished seed leaves."""

from __future__ import annotations

import concurrent.futures
import csv
import dataclasses
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

from agents.settings import Settings
from bufgym.benchmark.cluster import end_with
from bufgym.errors import BufgymError
from bufgym.files import locked, replaced

RUNS = Path("runs")
MODEL = "model.safetensors"
"""The file that holds an agent as weights which bufgym runs without torch."""
FREE = {"name", "resume", "steps", "checkpoint_every", "validate_every", "episodes", "seeds", "backend", "address"}
"""Settings that may differ between a run and its resumption."""

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Run:
    """One seed's finished training."""

    seed: int
    """The training seed."""
    folder: Path
    """Where its files are: runs/NAME/seed-SEED."""
    seconds: float
    """Time spent training, over all its sessions, s."""
    curve: list[Numbers]
    """(steps, seconds, mean QoI of the latest training episodes, or an evolved agent's fitness), a row an update."""
    validation: list[Numbers]
    """(steps, seconds, measures; the last one is what the agent to keep is chosen by), a row a validation."""
    file: str = "model.zip"
    """The kept agent's file in ``folder``."""
    best: Callable[..., Any] = min
    """``min`` or ``max``: which of the validations' last measures is the best."""

    @property
    def model(self) -> Path:
        """The kept agent's file."""
        return self.folder / self.file

    @property
    def reached(self) -> float:
        """The best measure on validation."""
        return float(self.best(row[-1] for row in self.validation))

    @property
    def merit(self) -> float:
        """The more the better: the best measure on validation."""
        return self.reached if self.best is max else -self.reached


# --- the run's folder ------------------------------------------------------------------------------------------------


def prepare(settings: Settings) -> Path:
    """The run's folder: made for a new run, checked against these settings for one that goes on."""
    settings.checked()
    folder = RUNS / (settings.name or _default_name(settings.resume))
    if settings.resume:
        if not (folder / "settings.json").exists():
            raise BufgymError(f"--resume: there is no run in {folder}")
    elif folder.exists() and any(not path.name.startswith(".") for path in folder.iterdir()):
        raise BufgymError(f"{folder} exists: choose another --name, or --resume it")
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        values = dataclasses.asdict(settings)
        if settings.resume:
            before = read_settings(folder)
            changed = [name for name in values if name not in FREE and before.get(name) != values[name]]
            if changed:
                changes = ", ".join(f"{name} was {before.get(name)!r}, now {values[name]!r}" for name in changed)
                raise BufgymError(f"--resume: give the settings that the run in {folder} began with: {changes}")
        with replaced(folder / "settings.json") as file:
            file.write_text(json.dumps({"command": settings.command, **values}, indent=2) + "\n", encoding="utf-8")
    return folder


def write_notes(
    folder: Path, settings: Settings, seeds: Sequence[int], scores: Mapping[str, Any] | None = None
) -> None:
    """Write what ``bufgym export`` says of the model in this folder: notes.json."""
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
    """So many processes, which end when this one does. Fresh interpreters: torch's threads do not survive a fork."""
    context = multiprocessing.get_context("spawn")
    return concurrent.futures.ProcessPoolExecutor(workers, context, end_with, (os.getpid(),))


def each_seed(train: Callable[[Settings, Path, int, int], Run], settings: Settings, folder: Path) -> list[Run]:
    """``train`` (settings, the run's folder, seed, line of its progress bar) for every seed, a process each."""
    seeds = range(settings.seed, settings.seed + settings.seeds)
    for seed in seeds:
        (folder / f"seed-{seed}").mkdir(exist_ok=True)
        write_notes(folder / f"seed-{seed}", settings, [seed])
    if len(seeds) == 1:
        return [train(settings, folder, seeds[0], 0)]
    waiting = list(seeds)
    runs: dict[int, Run] = {}
    while waiting:
        with pool_of(min(len(waiting), os.cpu_count() or 1)) as pool:
            jobs = {seed: pool.submit(train, settings, folder, seed, seed - seeds[0]) for seed in waiting}
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


# --- a seed's curves -------------------------------------------------------------------------------------------------


class Record:
    """Rows (steps, seconds, ...) in a CSV file that grows; a resumed run keeps those up to its checkpoint."""

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
    """A seed's validations, ``validate_every`` steps apart, in validation.csv; which was the best of them.

    Args:
        home: the seed's folder.
        columns: names of the measures; the last one is what the agent to keep is chosen by.
        best: ``min`` or ``max``: which of its values is the best.
        steps: where training goes on from; later rows are left out.
    """

    def __init__(
        self, home: Path, columns: tuple[str, ...], best: Callable[..., Any], settings: Settings, steps: int
    ) -> None:
        self.settings, self.columns, self.choose = settings, columns, best
        self.record = Record(home / "validation.csv", ("steps", "seconds", *columns), steps)

    @property
    def rows(self) -> list[Numbers]:
        """(steps, seconds, *measures), a row a validation."""
        return self.record.rows

    @property
    def best(self) -> Numbers:
        """The best row; the earliest of several."""
        row: Numbers = self.choose(self.rows, key=lambda row: row[-1])
        return row

    def due(self, steps: int) -> bool:
        """Whether it is time again; at the beginning and at the end it always is."""
        if not self.rows:
            return True
        since = steps - self.rows[-1][0]
        return since >= self.settings.validate_every or (steps >= self.settings.steps and since > 0)

    def add(self, steps: int, seconds: float, measures: Numbers) -> bool:
        """Note a validation; whether it is the best so far."""
        self.record.append(steps, round(seconds, 3), *measures)
        return self.best is self.rows[-1]


def seed_bar(steps: int, done: int, seed: int, line: int) -> Any:
    """A seed's progress bar, on a terminal alone; ``line``: where it goes."""
    return tqdm(
        total=steps,
        initial=done,
        desc=f"seed {seed}",
        unit=" steps",
        unit_scale=True,
        position=line,
        disable=not sys.stderr.isatty(),
    )

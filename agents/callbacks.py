"""What happens between updates: checkpoints, the learning curve, validation, a progress bar."""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from agents.trials import ValidationSet, Verdict
from bufgym.files import replaced


def checkpoints(home: Path) -> list[Path]:
    """A seed's checkpoints, oldest first."""
    return sorted((home / "checkpoints").glob("*.zip"))


def checkpoint(home: Path, steps: int) -> Path:
    """Where the learner is saved after so many steps."""
    return home / "checkpoints" / f"{steps:012d}.zip"


def save(model: BaseAlgorithm, home: Path) -> None:
    """The whole learner (weights, optimizer, counters), whole or not at all: a kill leaves no broken file."""
    path = checkpoint(home, model.num_timesteps)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced(path) as unfinished:
        model.save(unfinished)


class Record:
    """Rows (steps, seconds, ...) in a CSV file that grows; a resumed run keeps those up to its checkpoint."""

    def __init__(self, path: Path, columns: tuple[str, ...], steps: int) -> None:
        self.path = path
        self.rows: list[tuple[float, ...]] = []
        if path.exists():
            with path.open(newline="", encoding="utf-8") as file:
                read = [tuple(float(row[name]) for name in columns) for row in csv.DictReader(file)]
            self.rows = [(int(row[0]), *row[1:]) for row in read if row[0] <= steps]
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([columns, *self.rows])

    def append(self, *row: float) -> None:
        self.rows.append(row)
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(row)


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


class Between(BaseCallback):
    """A callback that asks nothing of single steps."""

    def _on_step(self) -> bool:
        return True


class Checkpoints(Between):
    """Saves the learner every so many steps, between updates."""

    def __init__(self, home: Path, every: int) -> None:
        super().__init__()
        self.home, self.every = home, every
        self.last = 0

    def _on_training_start(self) -> None:
        self.last = self.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps - self.last >= self.every:
            self.last = self.model.num_timesteps
            save(self.model, self.home)


class Curve(Between):
    """Mean QoI of the latest training episodes, a row an update."""

    def __init__(self, path: Path, steps: int) -> None:
        super().__init__()
        self.record = Record(path, ("steps", "seconds", "qoi"), steps)
        self.before = self.record.rows[-1][1] if self.record.rows else 0.0
        self.began = time.perf_counter()

    def spent(self) -> float:
        """Seconds of training, over all sessions."""
        return round(self.before + time.perf_counter() - self.began, 3)

    def told(self) -> str:
        """The latest, for people."""
        return f"QoI {self.record.rows[-1][2]:.3f}" if self.record.rows else ""

    def _on_training_start(self) -> None:
        self.began = time.perf_counter()

    def _on_rollout_end(self) -> None:
        ended = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        qoi = 1 + float(np.mean(ended)) if ended else float("nan")
        self.record.append(self.num_timesteps, self.spent(), qoi)
        self.logger.record("rollout/qoi", qoi)


class Validation(Between):
    """Every so many steps, plays the validation split and saves what did; the best of these is the one to keep."""

    def __init__(self, home: Path, every: int, trials: ValidationSet, seats: int, curve: Curve, steps: int) -> None:
        super().__init__()
        self.home, self.every, self.trials, self.seats, self.curve = home, every, trials, seats, curve
        self.record = Record(home / "validation.csv", ("steps", "seconds", *Verdict._fields), steps)

    @property
    def rows(self) -> list[tuple[float, ...]]:
        return self.record.rows

    def best(self) -> tuple[float, ...]:
        """The row with the least regret over AFR's; the earliest of several."""
        return min(self.rows, key=lambda row: row[4])

    def told(self) -> str:
        """The latest, for people."""
        return f"validation score {self.rows[-1][2]:.4f}, regret {self.rows[-1][4]:.3f} x AFR's" if self.rows else ""

    def _on_rollout_start(self) -> None:
        if not self.rows or self.model.num_timesteps - self.rows[-1][0] >= self.every:
            self.validate(self.model)

    def validate(self, model: Any) -> None:
        """Once for each number of steps. Saved first: a row always has its checkpoint."""
        if self.rows and self.rows[-1][0] == model.num_timesteps:
            return
        save(model, self.home)
        verdict = self.trials.verdict(model, self.seats)
        self.record.append(model.num_timesteps, self.curve.spent(), *verdict)
        for name, number in zip(verdict._fields, verdict, strict=True):
            model.logger.record(f"validation/{name}", number)


class Progress(Between):
    """A bar with the time left on a terminal, a plain line every tenth of the way elsewhere."""

    def __init__(self, shown: Curve | Validation, steps: int, seed: int, line: int) -> None:
        super().__init__()
        self.shown, self.steps, self.seed, self.line = shown, steps, seed, line
        self.bar: Any = None
        self.told = self.first = 0
        self.began = 0.0

    def _on_training_start(self) -> None:
        self.told = self.first = self.num_timesteps
        self.began = time.perf_counter()
        self.bar = seed_bar(self.steps, self.num_timesteps, self.seed, self.line)

    def _on_rollout_end(self) -> None:
        self.bar.update(self.num_timesteps - self.bar.n)
        self.bar.set_postfix_str(self.shown.told(), refresh=False)
        if self.bar.disable and (self.num_timesteps - self.told) * 10 >= self.steps:
            self.told = self.num_timesteps
            spent = time.perf_counter() - self.began
            left = max(0.0, spent / (self.told - self.first) * (self.steps - self.told))
            progress = f"{self.told:,} of {self.steps:,} steps, {self.shown.told()}"
            print(f"seed {self.seed}: {progress}, {left:.0f} s left", flush=True)

    def _on_training_end(self) -> None:
        self.bar.close()

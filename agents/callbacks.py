"""Work between a learner's updates: checkpoints, the learning curve, validation, a progress bar."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from agents.runs import Numbers, Record, Validations, seed_bar
from agents.settings import Settings
from bufgym.utils.files import replaced


def checkpoints(home: Path) -> list[Path]:
    """A seed's checkpoints, oldest first."""
    return sorted((home / "checkpoints").glob("*.zip"))


def checkpoint(home: Path, steps: int) -> Path:
    """Path of the learner's file after so many steps."""
    return home / "checkpoints" / f"{steps:012d}.zip"


def save(model: BaseAlgorithm, home: Path) -> None:
    """Save the whole learner (weights, optimizer, counters), whole or not at all: a kill leaves no broken file."""
    path = checkpoint(home, model.num_timesteps)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced(path) as unfinished:
        model.save(unfinished)


class BetweenUpdates(BaseCallback):
    """A callback that does nothing at single steps."""

    def _on_step(self) -> bool:
        return True


class Checkpoints(BetweenUpdates):
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


class Curve(BetweenUpdates):
    """Mean QoI of the latest training episodes, a row per update."""

    def __init__(self, path: Path, steps: int) -> None:
        super().__init__()
        self.record = Record(path, ("steps", "seconds", "qoi"), steps)
        self.before = self.record.rows[-1][1] if self.record.rows else 0.0
        self.began = time.perf_counter()

    def spent(self) -> float:
        """Seconds of training, over all sessions."""
        return round(self.before + time.perf_counter() - self.began, 3)

    def _on_training_start(self) -> None:
        self.began = time.perf_counter()

    def _on_rollout_end(self) -> None:
        returns = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        qoi = 1 + float(np.mean(returns)) if returns else float("nan")
        self.record.append(self.num_timesteps, self.spent(), qoi)
        self.logger.record("rollout/qoi", qoi)


class Validation(BetweenUpdates):
    """Validates when it is due and saves the validated learner: every row of validation.csv has its checkpoint.

    Args:
        home: the seed's folder.
        validations: the seed's validations so far.
        measure: model -> the measures in ``validations``' columns.
        message: format of the measures in words.
        curve: has the seconds of training.
    """

    def __init__(
        self, home: Path, validations: Validations, measure: Callable[[Any], Numbers], message: str, curve: Curve
    ) -> None:
        super().__init__()
        self.home, self.validations, self.measure, self.message, self.curve = home, validations, measure, message, curve

    def latest(self) -> str:
        """The latest validation in words."""
        rows = self.validations.rows
        return self.message.format(*rows[-1][2:]) if rows else ""

    def _on_rollout_start(self) -> None:
        self.validate(self.model)

    def validate(self, model: Any, last: bool = False) -> None:
        """Validate if it is due, or the last time."""
        if not self.validations.due(model.num_timesteps, last):
            return
        save(model, self.home)
        measures = self.measure(model)
        self.validations.add(model.num_timesteps, self.curve.spent(), measures)
        for name, number in zip(self.validations.columns, measures, strict=True):
            model.logger.record(f"validation/{name}", number)


class Progress(BetweenUpdates):
    """A bar with the time left on a terminal; elsewhere a plain line every tenth of the way."""

    def __init__(self, source: Validation, settings: Settings, seed: int, line: int) -> None:
        super().__init__()
        self.source, self.steps, self.seed, self.line = source, settings.steps, seed, line
        self.bar: Any = None
        self.printed = self.first = 0
        self.began = 0.0

    def _on_training_start(self) -> None:
        self.printed = self.first = self.num_timesteps
        self.began = time.perf_counter()
        self.bar = seed_bar(self.steps, self.num_timesteps, self.seed, self.line)

    def _on_rollout_end(self) -> None:
        self.bar.update(self.num_timesteps - self.bar.n)
        self.bar.set_postfix_str(self.source.latest(), refresh=False)
        if self.bar.disable and (self.num_timesteps - self.printed) * 10 >= self.steps:
            self.printed = self.num_timesteps
            spent = time.perf_counter() - self.began
            left = max(0.0, spent / (self.printed - self.first) * (self.steps - self.printed))
            progress = f"{self.printed:,} of {self.steps:,} steps, {self.source.latest()}"
            print(f"seed {self.seed}: {progress}, {left:.0f} s left", flush=True)

    def _on_training_end(self) -> None:
        self.bar.close()


class Budget(BetweenUpdates):
    """Ends the training after so many seconds."""

    def __init__(self, seconds: float, curve: Curve) -> None:
        super().__init__()
        self.seconds, self.curve = seconds, curve

    def _on_step(self) -> bool:
        return self.curve.spent() < self.seconds

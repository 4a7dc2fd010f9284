"""Training MaskablePPO: settings, checkpoints, resuming, one process a seed.

PPO is bound here by its updates, not by the environment (a compiled step of 256 environments costs as much as one
gradient step on a few hundred decisions). So: large batches, few epochs, a small network, one torch thread a process.
"""

from __future__ import annotations

import concurrent.futures
import csv
import dataclasses
import json
import multiprocessing
import os
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from tqdm import tqdm

from agents.evaluate import worlds
from agents.network import policy_of
from bufgym.benchmark.rows import replaced
from bufgym.errors import BufgymError
from bufgym.sb3 import GymVecEnv, make_vec_env

if TYPE_CHECKING:
    from train import Arguments

RUNS = Path("runs")
FREE = {"name", "resume", "steps", "checkpoint_every", "episodes", "seeds"}
"""Arguments that may differ between a run and its resumption."""


@dataclass(frozen=True)
class Run:
    """One seed's finished training."""

    seed: int
    folder: Path
    seconds: float
    """Time spent training, over all its sessions."""
    curve: list[tuple[int, float, float]]
    """(steps, seconds, mean QoI of the latest training episodes), a row an update."""

    @property
    def model(self) -> Path:
        return self.folder / "model.zip"

    @property
    def score(self) -> float:
        """Mean QoI in the last tenth of training."""
        last = [qoi for _, _, qoi in self.curve[-max(1, len(self.curve) // 10) :]]
        return float(np.mean(last)) if last else float("nan")


# --- the run's folder ------------------------------------------------------------------------------------------------


def prepare(arguments: Arguments) -> Path:
    """The run's folder: made for a new run, checked against these arguments for one that goes on."""
    folder = RUNS / (arguments.name or _default_name(arguments.resume))
    noted = folder / "settings.json"
    given = dataclasses.asdict(arguments)
    if arguments.resume:
        if not noted.exists():
            raise SystemExit(f"--resume: there is no run in {folder}")
        before = json.loads(noted.read_text(encoding="utf-8"))
        changed = [key for key in given if key not in FREE and before.get(key) != given[key]]
        if changed:
            told = ", ".join(f"{key} was {before.get(key)!r}, now {given[key]!r}" for key in changed)
            raise SystemExit(f"--resume: give the arguments that the run in {folder} began with: {told}")
    elif folder.exists():
        raise SystemExit(f"{folder} exists: choose another --name, or --resume it")
    folder.mkdir(parents=True, exist_ok=True)
    noted.write_text(json.dumps(given, indent=2) + "\n", encoding="utf-8")
    return folder


def _default_name(resume: bool) -> str:
    """The last of train-1, train-2, ... to resume, or the next."""
    taken = [int(p.name[6:]) for p in RUNS.glob("train-*") if p.name[6:].isdigit()]
    return f"train-{max(taken, default=0) + (0 if resume and taken else 1)}"


def checkpoints(folder: Path) -> list[Path]:
    """A seed's checkpoints, oldest first."""
    return sorted((folder / "checkpoints").glob("*.zip"))


def save(model: MaskablePPO, path: Path) -> None:
    """Whole or not at all: a kill while writing leaves no broken file under this name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced(path) as unfinished:
        model.save(unfinished)


# --- training --------------------------------------------------------------------------------------------------------


def train_all(arguments: Arguments, folder: Path) -> list[Run]:
    """Train every seed, in processes of their own if there are several."""
    seeds = range(arguments.seed, arguments.seed + arguments.seeds)
    if not seeds:
        raise BufgymError(f"seeds = {arguments.seeds}: must be >= 1")
    if len(seeds) == 1:
        return [train_seed(arguments, folder, seeds[0])]
    workers = min(len(seeds), os.cpu_count() or 1)
    # A fresh interpreter each: torch's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
        jobs = [pool.submit(train_seed, arguments, folder, seed, line) for line, seed in enumerate(seeds)]
        return [job.result() for job in jobs]


def train_seed(arguments: Arguments, folder: Path, seed: int, line: int = 0) -> Run:
    """Train one seed to the end, from its latest checkpoint if there is one. ``line``: where its bar goes."""
    torch.set_num_threads(1)
    home = folder / f"seed-{seed}"
    home.mkdir(exist_ok=True)
    env = training_env(arguments)
    saved = checkpoints(home)
    model = MaskablePPO.load(saved[-1], env=env, device="cpu") if saved else new_model(arguments, env)
    # Every session has luck of its own, told by where it begins: the episodes before a kill do not come again.
    model.set_random_seed(int(np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1)[0]))
    model.set_logger(configure(str(home / "tensorboard"), ["tensorboard"]))
    curve = Curve(home / "curve.csv", model.num_timesteps)
    progress = Progress(curve, arguments.steps, seed, line)
    left = arguments.steps - model.num_timesteps
    if left > 0:
        # The library counts ``total_timesteps`` from here on when the count is not reset.
        model.learn(left, [Checkpoints(home, arguments.checkpoint_every), curve, progress], reset_num_timesteps=False)
        save(model, home / "checkpoints" / f"{model.num_timesteps:012d}.zip")
    model.logger.close()
    env.close()
    shutil.copyfile(checkpoints(home)[-1], home / "model.zip")
    return Run(seed, home, curve.seconds, curve.rows)


def training_env(arguments: Arguments) -> GymVecEnv:
    """The batch of environments to train on."""
    return make_vec_env(
        arguments.env,
        arguments.num_envs,
        scenario=worlds(arguments)[0],
        capacity=arguments.capacity,
        decide_at=arguments.decide_at,
        reward=arguments.reward,
    )


def new_model(arguments: Arguments, env: GymVecEnv) -> MaskablePPO:
    """An untrained agent."""
    policy, settings = policy_of(arguments.network, arguments.width)
    return MaskablePPO(
        policy,
        env,
        learning_rate=LinearSchedule(arguments.learning_rate, 0.0, 1.0),
        n_steps=arguments.n_steps,
        batch_size=min(arguments.batch_size, arguments.n_steps * arguments.num_envs),
        n_epochs=arguments.epochs,
        gamma=arguments.gamma,
        gae_lambda=arguments.gae_lambda,
        ent_coef=arguments.entropy,
        stats_window_size=arguments.num_envs,
        policy_kwargs=settings,
        device="cpu",
    )


class Checkpoints(BaseCallback):
    """Saves the whole learner (weights, optimizer, counters) every so many steps, between updates."""

    def __init__(self, home: Path, every: int) -> None:
        super().__init__()
        self.home, self.every = home, every
        self.last = 0

    def _on_training_start(self) -> None:
        self.last = self.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps - self.last >= self.every:
            self.last = self.model.num_timesteps
            assert isinstance(self.model, MaskablePPO)
            save(self.model, self.home / "checkpoints" / f"{self.last:012d}.zip")

    def _on_step(self) -> bool:
        return True


class Curve(BaseCallback):
    """The learning curve, written to a CSV file as it grows; a resumed run keeps the rows up to its checkpoint."""

    def __init__(self, path: Path, steps: int) -> None:
        super().__init__()
        self.path = path
        self.rows: list[tuple[int, float, float]] = []
        if path.exists():
            with path.open(newline="", encoding="utf-8") as file:
                read = [(int(r["steps"]), float(r["seconds"]), float(r["qoi"])) for r in csv.DictReader(file)]
            self.rows = [row for row in read if row[0] <= steps]
        self.seconds_before = self.rows[-1][1] if self.rows else 0.0
        self.began = time.perf_counter()
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([("steps", "seconds", "qoi"), *self.rows])

    @property
    def seconds(self) -> float:
        return self.rows[-1][1] if self.rows else 0.0

    def _on_training_start(self) -> None:
        self.began = time.perf_counter()

    def _on_rollout_end(self) -> None:
        ended = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        qoi = 1 + float(np.mean(ended)) if ended else float("nan")
        row = (self.num_timesteps, round(self.seconds_before + time.perf_counter() - self.began, 3), qoi)
        self.rows.append(row)
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(row)
        self.logger.record("rollout/qoi", qoi)

    def _on_step(self) -> bool:
        return True


class Progress(BaseCallback):
    """A bar with the time left on a terminal, a plain line every tenth of the way elsewhere."""

    def __init__(self, curve: Curve, steps: int, seed: int, line: int) -> None:
        super().__init__()
        self.curve, self.steps, self.seed, self.line = curve, steps, seed, line
        self.bar: Any = None
        self.told = self.first = 0

    def _on_training_start(self) -> None:
        self.told = self.first = self.num_timesteps
        self.bar = tqdm(
            total=self.steps,
            initial=self.num_timesteps,
            desc=f"seed {self.seed}",
            unit=" steps",
            unit_scale=True,
            position=self.line,
            disable=not sys.stderr.isatty(),
        )

    def _on_rollout_end(self) -> None:
        qoi = self.curve.rows[-1][2] if self.curve.rows else float("nan")
        self.bar.update(self.num_timesteps - self.bar.n)
        self.bar.set_postfix_str(f"QoI {qoi:.3f}", refresh=False)
        if self.bar.disable and (self.num_timesteps - self.told) * 10 >= self.steps:
            self.told = self.num_timesteps
            spent = time.perf_counter() - self.curve.began
            left = max(0.0, spent / (self.told - self.first) * (self.steps - self.told))
            print(
                f"seed {self.seed}: {self.told:,} of {self.steps:,} steps, QoI {qoi:.3f}, {left:.0f} s left", flush=True
            )

    def _on_training_end(self) -> None:
        self.bar.close()

    def _on_step(self) -> bool:
        return True

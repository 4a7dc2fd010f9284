"""Learners of stable-baselines3, which learn from single decisions: checkpoints, resuming, validation.

Updates bound them, not the environment. A compiled step of 256 environments costs as much as one gradient step on a few
hundred decisions. So the network is small, and a process has one torch thread.
"""

from __future__ import annotations

import shutil
from abc import abstractmethod
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv

from agents.callbacks import Budget, Checkpoints, Curve, Progress, Validation, checkpoint, checkpoints, save
from agents.learner import Learner
from agents.runs import MODEL, Numbers, Run, Validations
from agents.settings import SingleDecisions
from bufgym.policies import weights
from bufgym.sb3 import export

Decisions = TypeVar("Decisions", bound=SingleDecisions)


class DecisionLearner(Learner[Decisions]):
    """An algorithm of stable-baselines3, on the flat observation of ordered candidates.

    Its agent is a compiled policy for every L.
    """

    @property
    @abstractmethod
    def algorithm(self) -> Any:
        """Its class, by which its file is read."""

    @abstractmethod
    def make(self, env: VecEnv) -> Any:
        """Make an untrained model."""

    def env(self, folder: Path, seed: int = 0) -> VecEnv:
        """The batch of environments to train on: asked at a full buffer, where every action is valid."""
        settings = self.settings
        objective = self.objective(folder, seed)
        return objective.env(settings.num_envs, settings.reward, candidates=settings.candidates, info="mask")

    def train_seed(self, folder: Path, seed: int, line: int = 0) -> Run:
        """Train one seed for its steps or so many seconds, from its latest checkpoint if any."""
        torch.set_num_threads(1)
        home, settings = folder / f"seed-{seed}", self.settings
        home.mkdir(exist_ok=True)
        objective = self.objective(folder, seed)
        env, saved = self.env(folder, seed), checkpoints(home)
        torch.manual_seed(seed)  # for the first weights
        model = self.algorithm.load(saved[-1], env=env, device="cpu") if saved else self.make(env)
        # Every session has a seed of its own, by its first step: the episodes before a kill do not come again.
        model.set_random_seed(int(np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1)[0]))
        model.set_logger(configure(str(home / "tensorboard"), ["tensorboard"]))
        curve = Curve(home / "curve.csv", model.num_timesteps)

        def measure(model: Any) -> Numbers:
            return objective.validate(export.weights_of(model).policy(settings.algo))

        validations = Validations(home, objective.columns, objective.best, settings, model.num_timesteps)
        validation = Validation(home, validations, measure, objective.message, curve)
        left = settings.steps - model.num_timesteps
        if left > 0:
            callbacks: list[BaseCallback] = [Checkpoints(home, settings.checkpoint_every), curve, validation]
            callbacks += [Progress(validation, settings, seed, line), Budget(self.seconds, curve)]
            # The library counts ``total_timesteps`` from here on when the count is not reset.
            model.learn(left, callbacks, reset_num_timesteps=False)
            save(model, home)
        validation.validate(model, last=True)
        model.logger.close()
        env.close()
        shutil.copyfile(checkpoint(home, int(validations.best[0])), home / "model.zip")
        spent = curve.record.rows[-1][1] if curve.record.rows else 0.0
        kept = self.algorithm.load(home / "model.zip", device="cpu")
        weights.save(home / MODEL, export.weights_of(kept), self.notes(seed, settings.algo))
        return Run(seed, home, spent, curve.record.rows, validations.rows, validations.choose)

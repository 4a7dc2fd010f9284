"""Training agents by PPO, DQN or evolution: checkpoints, resuming, one process a seed.

PPO is bound here by its updates, not by the environment. A compiled step of 256 environments costs as much as one
gradient step on a few hundred decisions. So batches are large, epochs few, the network small, and a process has one
torch thread.
"""

from __future__ import annotations

import functools
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3 as sb3
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from agents import cma_es, guided_ppo
from agents.callbacks import Checkpoints, Curve, Progress, Validation, checkpoint, checkpoints, save
from agents.cluster import running
from agents.dqn import MaskedDQN, MaskedDQNPolicy, dqn_policy_of
from agents.held_out import split_scenario
from agents.mixed_env import MixedEnv, cells
from agents.objectives import OBJECTIVES
from agents.objectives.fleet import fleet_of
from agents.runs import MODEL, Numbers, Run, Validations, each_seed
from agents.settings import DQN, PPO, Evolve, GuidedPPO, Learner, Settings, SlotEnvironment
from bufgym.envs import FleetVecEnv
from bufgym.ground.errors import BufgymError
from bufgym.policies import weights
from bufgym.sb3 import GymVecEnv, make_vec_env
from bufgym.sb3 import weights_of as slot_weights
from bufgym.sb3.networks import policy_of


def train_all(settings: Settings, folder: Path) -> list[Run]:
    """Train every seed, in processes of their own if there are several; with a cluster they share it."""
    OBJECTIVES[settings.kind](settings, folder, settings.seed).prepare()
    if isinstance(settings, Learner):
        return each_seed(train_seed, settings, folder)
    assert isinstance(settings, Evolve)
    if settings.cluster is None:
        return each_seed(cma_es.train, settings, folder)
    with running(settings.cluster) as cluster:
        return each_seed(cma_es.train, replace(settings, cluster=cluster), folder)


def train_beside(settings: Settings, folder: Path, runs: Sequence[Run]) -> list[Run]:
    """PPO on the actions of evolved agents, for no longer than the longest of their runs."""
    home, seconds = folder / "ppo", max(run.seconds for run in runs)
    home.mkdir(exist_ok=True)
    print(f"PPO on the same actions, for at most {seconds:.0f} s")
    shared = ("environment", "validation_episodes", "name", "resume", "seeds", "seed")
    steps = min(settings.steps, GuidedPPO.steps)
    other = GuidedPPO(steps=steps, **{name: getattr(settings, name) for name in shared})
    return each_seed(functools.partial(train_seed, seconds=seconds), other, home)


def train_seed(settings: Learner, folder: Path, seed: int, line: int = 0, seconds: float = math.inf) -> Run:
    """Train one seed for its steps or so many seconds, from its latest checkpoint if any.

    ``line`` is the line of its progress bar.
    """
    torch.set_num_threads(1)
    home = folder / f"seed-{seed}"
    home.mkdir(exist_ok=True)
    env = ENVS[settings.kind](settings)
    algorithm, new = class_of(settings), LEARNERS[settings.algo]
    saved = checkpoints(home)
    torch.manual_seed(seed)  # for the first weights
    model = algorithm.load(saved[-1], env=env, device="cpu") if saved else new(settings, env)
    # Every session has a seed of its own, by its first step: the episodes before a kill do not come again.
    model.set_random_seed(int(np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1)[0]))
    model.set_logger(configure(str(home / "tensorboard"), ["tensorboard"]))
    curve = Curve(home / "curve.csv", model.num_timesteps)
    validation = validation_of(settings, folder, home, curve, model.num_timesteps)
    progress = Progress(validation, settings, seed, line)
    left = settings.steps - model.num_timesteps
    if left > 0:
        callbacks: list[BaseCallback] = [Checkpoints(home, settings.checkpoint_every), curve, validation, progress]
        if isinstance(settings, GuidedPPO):
            callbacks.append(guided_ppo.Budget(seconds, curve, settings.steps))
        # The library counts ``total_timesteps`` from here on when the count is not reset.
        model.learn(left, callbacks, reset_num_timesteps=False)
        save(model, home)
    validation.validate(model, last=True)
    rows, best = validation.validations.rows, validation.validations.choose
    kept = checkpoint(home, int(validation.validations.best[0]))
    model.logger.close()
    env.close()
    shutil.copyfile(kept, home / "model.zip")
    spent = curve.record.rows[-1][1] if curve.record.rows else 0.0
    file = "model.zip"
    if is_compiled(settings):
        file, found = MODEL, weights_of(algorithm.load(kept, device="cpu"))
        notes = {
            "name": settings.algo,
            "suite": ",".join(settings.suites.suite),
            "seeds": [seed],
            "algo": settings.algo,
        }
        weights.save(home / MODEL, found, notes)
    return Run(seed, home, spent, curve.record.rows, rows, file, best)


def is_compiled(settings: Settings) -> bool:
    """Whether the learner's weights are a policy that runs without torch on this kind of task."""
    return settings.kind == "fleet" or isinstance(settings, GuidedPPO)


def weights_of(model: Any) -> Any:
    """The weights of a learner that guides a rule or scores slots."""
    return guided_ppo.weights_of(model) if isinstance(model.policy, guided_ppo.GuidedPolicy) else slot_weights(model)


def validation_of(settings: Learner, folder: Path, home: Path, curve: Curve, steps: int) -> Validation:
    """The validation of a learner, by the measures of evolved agents."""
    objective = OBJECTIVES[settings.kind](settings, folder, settings.seed)

    def measure(model: Any) -> Numbers:
        if is_compiled(settings):
            return objective.validate(weights.policy_of(objective.name, weights_of(model)))
        return objective.validate_learner(model)

    validations = Validations(home, objective.columns, objective.best, settings, steps)
    return Validation(home, validations, measure, objective.message, curve)


def fleet_env(settings: PPO) -> VecEnv:
    """Robots as rows, each rewarded for its own information, at the middle L; a slot network serves the others too."""
    fleet, capacities = fleet_of(settings.suites, "train"), settings.suites.capacities_of(settings.suites.suite[0])
    batch = FleetVecEnv(
        max(1, settings.num_envs // fleet.robots),
        fleet.robots,
        fleet.uplink,
        capacities[len(capacities) // 2],
        reward="own",
        term=settings.reward,
        autoreset_mode="SameStep",
    )
    return GymVecEnv(batch)


def suites_env(settings: PPO | DQN) -> VecEnv:
    """Whole train splits, about as many rows of each scenario at each L."""
    chosen = settings.suites
    mixed = [cell for suite in chosen.suite for cell in cells(suite, "train", chosen.capacities_of(suite), chosen.data)]
    size = math.ceil(settings.num_envs / len(mixed))
    return GymVecEnv(MixedEnv(mixed, [size] * len(mixed), reward=settings.reward))


def one_env(settings: PPO | DQN | GuidedPPO) -> VecEnv:
    """Rows of one scenario."""
    on = settings.environment
    return make_vec_env(
        on.env,
        settings.num_envs,
        scenario=split_scenario(on)[0],
        capacity=on.capacity,
        reward=settings.reward,
        **({"decide_at": on.decide_at} if isinstance(on, SlotEnvironment) else guided_ppo.OPTIONS),
    )


ENVS: dict[str, Callable[[Any], VecEnv]] = {"environment": one_env, "queue": suites_env, "fleet": fleet_env}
"""Kind of task -> the batch of environments to train on."""


def new_ppo(settings: PPO | GuidedPPO, env: VecEnv) -> MaskablePPO | sb3.PPO:
    """Make an untrained actor and critic; a guided one is still the rule."""
    n_steps = settings.n_steps
    if isinstance(settings, GuidedPPO):
        policy, policy_settings = guided_ppo.GuidedPolicy, {"width": settings.width}
        n_steps = min(n_steps, max(1, settings.steps // env.num_envs))
    else:
        policy, policy_settings = policy_of(settings.network, settings.width, not settings.unmasked)
    model: MaskablePPO | sb3.PPO = class_of(settings)(
        policy,
        env,
        learning_rate=LinearSchedule(settings.learning_rate, 0.0, 1.0),
        n_steps=n_steps,
        batch_size=even_batch(n_steps * env.num_envs, settings.batch_size),
        n_epochs=settings.epochs,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        ent_coef=settings.entropy,
        stats_window_size=env.num_envs,
        policy_kwargs=policy_settings,
        device="cpu",
    )
    return model


def even_batch(decisions: int, most: int) -> int:
    """The largest batch size up to ``most`` that divides the decisions, so that no noisy rest is left."""
    batches = -(-decisions // most)
    while decisions % batches:
        batches += 1
    if decisions // batches < 2:
        rule = f"num_envs x n_steps = {decisions} decisions an update must have a divisor from 2 to it"
        raise BufgymError(f"batch_size = {most}: {rule}")
    return decisions // batches


REPLAY = 100_000
"""Decisions in DQN's replay; at 32 slots they take about 250 MB."""


def new_dqn(settings: DQN, env: VecEnv) -> MaskedDQN:
    """Make an untrained Q network. It sees each decision as often as PPO (``epochs`` times), in smaller batches.

    It explores little: a message dropped at random is missing for the rest of the episode.
    """
    batch = max(1, settings.batch_size // 4)
    steps = max(1, settings.n_steps // 16)
    return MaskedDQN(
        MaskedDQNPolicy,
        env,
        learning_rate=LinearSchedule(settings.learning_rate / 4, 0.0, 1.0),
        buffer_size=max(REPLAY, env.num_envs),
        learning_starts=4 * batch,
        batch_size=batch,
        gamma=settings.gamma,
        train_freq=(steps, "step"),
        gradient_steps=max(1, settings.epochs * steps * env.num_envs // batch),
        target_update_interval=max(8 * batch, env.num_envs),
        exploration_initial_eps=0.1,
        exploration_final_eps=0.01,
        exploration_fraction=0.5,
        stats_window_size=env.num_envs,
        policy_kwargs=dqn_policy_of(settings.network, settings.width),
        device="cpu",
    )


def class_of(settings: Settings) -> Any:
    """The learner's class, by which its file is read."""
    if isinstance(settings, DQN):
        return MaskedDQN
    return MaskablePPO if isinstance(settings, PPO) and not settings.unmasked else sb3.PPO


LEARNERS: dict[str, Callable[[Any, VecEnv], Any]] = {"guided-ppo": new_ppo, "ppo": new_ppo, "dqn": new_dqn}
"""Algorithm -> function that makes an untrained learner."""


def load(settings: Settings, run: Run) -> Any:
    """The learner that the run kept."""
    torch.set_num_threads(1)  # on batches this small, more threads only wait for one another
    return class_of(settings).load(run.folder / "model.zip", device="cpu")

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
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from agents import cma_es, guided_ppo
from agents.callbacks import Checkpoints, Curve, Progress, Validation, checkpoint, checkpoints, save
from agents.cluster import running
from agents.dqn import MaskedDQN, MaskedDQNPolicy, dqn_policy_of
from agents.evaluation import EvaluationSet, ValidationSets, Verdict
from agents.held_out import fixed_episodes, split_scenario
from agents.mixed_env import MixedEnv, cells
from agents.objectives.fleet import FleetObjective, fleet_of
from agents.runs import MODEL, Numbers, Run, Validations, each_seed
from agents.settings import Settings
from bufgym.benchmark.rows import Row
from bufgym.envs import FleetVecEnv
from bufgym.ground.errors import BufgymError
from bufgym.policies import learned, weights
from bufgym.policies import load as load_policy
from bufgym.sb3 import GymVecEnv, make_vec_env, weights_of
from bufgym.sb3.networks import policy_of


def train_all(settings: Settings, folder: Path) -> list[Run]:
    """Train every seed, in processes of their own if there are several; with a cluster they share it."""
    if settings.kind == "queue":
        ValidationSets(settings, folder, progress=True)  # compute the clairvoyant's bounds once for all seeds
    if settings.backend == "local":
        return each_seed(cma_es.train if settings.evolves else train_seed, settings, folder)
    with running(settings.backend, settings.address or None) as address:
        return each_seed(cma_es.train, replace(settings, address=address), folder)


def train_beside(settings: Settings, folder: Path, runs: Sequence[Run]) -> list[Run]:
    """With ``settings.beside``: PPO on the same actions, for no longer than the longest of the runs."""
    if not (settings.beside and settings.algo == "guided" and settings.kind == "environment"):
        return []
    home, seconds = folder / "ppo", max(run.seconds for run in runs)
    home.mkdir(exist_ok=True)
    print(f"PPO on the same actions, for at most {seconds:.0f} s")
    usual = replace(settings, algo="guided-ppo", steps=0, validate_every=0).resolved()
    other = replace(usual, steps=min(settings.steps, usual.steps))
    return each_seed(functools.partial(train_seed, seconds=seconds), other, home)


def train_seed(settings: Settings, folder: Path, seed: int, line: int = 0, seconds: float = math.inf) -> Run:
    """Train one seed for its steps or so many seconds, from its latest checkpoint if any.

    ``line`` is the line of its progress bar.
    """
    torch.set_num_threads(1)
    home = folder / f"seed-{seed}"
    home.mkdir(exist_ok=True)
    env = training_env(settings)
    algorithm, new = LEARNERS[settings.algo]
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
        callbacks = [Checkpoints(home, settings.checkpoint_every), curve, validation, progress]
        if settings.algo == "guided-ppo":
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
    if settings.kind == "fleet" or settings.algo == "guided-ppo":
        file, kept_model = MODEL, algorithm.load(kept, device="cpu")
        found = weights_of(kept_model) if settings.kind == "fleet" else guided_ppo.weights_of(kept_model)
        notes = {"name": settings.algo, "suite": settings.suite, "seeds": [seed], "algo": settings.algo}
        weights.save(home / MODEL, found, notes)
    return Run(seed, home, spent, curve.record.rows, rows, file, best)


def validation_of(settings: Settings, folder: Path, home: Path, curve: Curve, steps: int) -> Validation:
    """The validation of a learner on this kind of task."""
    if settings.kind == "environment":
        episodes = fixed_episodes(settings, "validation")

        def score(model: Any) -> Numbers:
            if settings.algo == "guided-ppo":
                outcomes = episodes.run(guided_ppo.weights_of(model).policy("ppo"))
            else:
                outcomes = episodes.play(model)
            return episodes.score(outcomes), float(np.mean([result.qoi for result in outcomes]))

        # By QoI, which orders agents like the score, and is known even if nothing can be gained.
        validations = Validations(home, ("score", "qoi"), max, settings, steps)
        return Validation(home, validations, score, lambda measures: f"validation score {measures[0]:.3f}", curve)
    if settings.kind == "fleet":
        objective = FleetObjective(settings, folder, settings.seed)

        def gain(model: Any) -> Numbers:
            return objective.validate(learned.policy(objective.name, weights_of(model)))

        validations = Validations(home, objective.columns, objective.best, settings, steps)
        return Validation(home, validations, gain, lambda measures: objective.message.format(measures[-1]), curve)
    sets, padded_slots = ValidationSets(settings, folder), padded_slots_of(settings)
    return Validation(
        home,
        Validations(home, Verdict._fields, min, settings, steps),
        lambda model: sets.play(model, padded_slots),
        lambda verdict: f"validation score {verdict[0]:.4f}, regret {verdict[2]:.3f} x AFR's",
        curve,
    )


def padded_slots_of(settings: Settings) -> int:
    """Slots that the agent of a suite observes."""
    return max(L for suite in settings.suites for L in settings.capacities_of(suite))


def training_env(settings: Settings) -> VecEnv:
    """The batch of environments to train on: of one scenario, of whole train splits, or of robots as rows."""
    if settings.kind == "fleet":
        # Each robot is rewarded for its own information, at the middle capacity; a slot network serves the others too.
        fleet, capacities = fleet_of(settings.suite, "train"), settings.capacities_of(settings.suite)
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
    if settings.kind == "queue":
        mixed = [
            cell
            for suite in settings.suites
            for cell in cells(suite, "train", settings.capacities_of(suite), settings.data or None)
        ]
        size = math.ceil(settings.num_envs / len(mixed))
        return GymVecEnv(MixedEnv(mixed, [size] * len(mixed), reward=settings.reward))
    if settings.algo == "guided-ppo":
        return guided_ppo.training_env(settings)
    return make_vec_env(
        settings.env,
        settings.num_envs,
        scenario=split_scenario(settings)[0],
        capacity=settings.capacity,
        decide_at=settings.decide_at,
        reward=settings.reward,
    )


def new_ppo(settings: Settings, env: VecEnv) -> MaskablePPO | PPO:
    """Make an untrained actor and critic; without masks an invalid action does what a queue does."""
    masked = settings.algo == "maskable-ppo"
    policy, policy_settings = policy_of(settings.network, settings.width, masked)
    return (MaskablePPO if masked else PPO)(
        policy,
        env,
        learning_rate=LinearSchedule(settings.learning_rate, 0.0, 1.0),
        n_steps=settings.n_steps,
        batch_size=even_batch(settings.n_steps * env.num_envs, settings.batch_size),
        n_epochs=settings.epochs,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        ent_coef=settings.entropy,
        stats_window_size=env.num_envs,
        policy_kwargs=policy_settings,
        device="cpu",
    )


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


def new_dqn(settings: Settings, env: VecEnv) -> MaskedDQN:
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


LEARNERS: dict[str, tuple[Any, Callable[[Settings, VecEnv], Any]]] = {
    "guided-ppo": (PPO, guided_ppo.new),
    "maskable-ppo": (MaskablePPO, new_ppo),
    "ppo": (PPO, new_ppo),
    "dqn": (MaskedDQN, new_dqn),
}
"""Algorithm -> (its class, function that makes an untrained one)."""

ALGORITHMS = (*LEARNERS, "guided")
"""Values of ``--algo``."""


def load(settings: Settings, run: Run) -> Any:
    """The learner that the run kept."""
    torch.set_num_threads(1)  # on batches this small, more threads only wait for one another
    return LEARNERS[settings.algo][0].load(run.folder / "model.zip", device="cpu")


def test_rows(settings: Settings, run: Run, evaluation: EvaluationSet) -> list[Row]:
    """The kept agent's rows on a suite's test split."""
    if settings.evolves:
        outcomes = evaluation.run(load_policy(run.model))
    else:
        outcomes = evaluation.play(load(settings, run), padded_slots_of(settings))
    return evaluation.benchmark_rows(outcomes, f"agent ({settings.algo})", run.seed)

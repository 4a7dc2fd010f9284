"""Training agents: settings, checkpoints, resuming, one process a seed.

PPO is bound here by its updates, not by the environment (a compiled step of 256 environments costs as much as one
gradient step on a few hundred decisions). So: large batches, few epochs, a small network, one torch thread a process.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule

from agents import evolution
from agents.callbacks import Checkpoints, Curve, Progress, Validation, checkpoint, checkpoints, save
from agents.dqn import MaskedDQN, MaskedDQNPolicy, dqn_policy_of
from agents.evaluate import Agent, worlds
from agents.seeds import each_seed, seeds_of
from agents.trials import Trials, ValidationSet, plan
from agents.worlds import World, capacities_of, cells
from bufgym.benchmark.fleets import SUITES as FLEET_SUITES
from bufgym.benchmark.rows import Row
from bufgym.policies import load as load_policy
from bufgym.sb3 import GymVecEnv, make_vec_env
from bufgym.sb3.networks import IgnoresMasks, policy_of
from bufgym.scenario import suites

if TYPE_CHECKING:
    from train import Arguments

RUNS = Path("runs")
FREE = {"name", "resume", "steps", "checkpoint_every", "validate_every", "episodes", "seeds"}
"""Arguments that may differ between a run and its resumption."""


@dataclass(frozen=True)
class Run:
    """One seed's finished training; the agent to keep is in ``model``."""

    seed: int
    folder: Path
    seconds: float
    """Time spent training, over all its sessions."""
    curve: list[tuple[float, ...]]
    """(steps, seconds, mean QoI of the latest training episodes), a row an update."""
    validation: list[tuple[float, ...]] = field(default_factory=list)
    """(steps, seconds, *Verdict), a row a validation, with the measure to choose by last; none without a suite."""

    file: str = "model.zip"

    @property
    def model(self) -> Path:
        return self.folder / self.file

    @property
    def merit(self) -> float:
        """The more the better: minus the least regret over the rivals' on validation, or without a suite the mean QoI
        in the last tenth of training."""
        if self.validation:
            return -min(row[-1] for row in self.validation)
        last = [row[2] for row in self.curve[-max(1, len(self.curve) // 10) :]]
        return float(np.mean(last)) if last else float("nan")


@dataclass(frozen=True)
class Algorithm:
    """One way to an agent."""

    train: Callable[[Arguments, Path, int, int], Run]
    """(arguments, the run's folder, seed, line of its progress bar) -> the finished seed."""
    test: Callable[[Arguments, Run, Trials], list[Row]]
    """Its rows on a suite's trials."""
    model: str = "model.zip"
    """The file of the agent to keep."""
    rival: str = "AFR's"
    """Over whose regret its own is on validation, where the agent to keep is chosen by that."""


# --- the run's folder ------------------------------------------------------------------------------------------------


def prepare(arguments: Arguments) -> Path:
    """The run's folder: made for a new run, checked against these arguments for one that goes on."""
    folder = RUNS / (arguments.name or _default_name(arguments.resume))
    noted = folder / "settings.json"
    given = dataclasses.asdict(arguments)
    if arguments.suite:
        for suite in arguments.suites:  # mistakes are told before anything is made
            if suite not in (*suites.TOPIC_SUITES, *FLEET_SUITES):
                plan(arguments, suite, "validation").checked()
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


# --- training --------------------------------------------------------------------------------------------------------


def train_all(arguments: Arguments, folder: Path) -> list[Run]:
    """Train every seed, in processes of their own if there are several."""
    seeds_of(arguments)
    if arguments.suite:
        ValidationSet(arguments, folder, progress=True)  # the clairvoyant's bounds are found once for all seeds
    return each_seed(ALGORITHMS[arguments.algo].train, arguments, folder)


def train_seed(arguments: Arguments, folder: Path, seed: int, line: int = 0) -> Run:
    """Train one seed to the end, from its latest checkpoint if there is one. ``line``: where its bar goes."""
    torch.set_num_threads(1)
    home = folder / f"seed-{seed}"
    home.mkdir(exist_ok=True)
    env = training_env(arguments)
    kind, new = LEARNERS[arguments.algo]
    saved = checkpoints(home)
    torch.manual_seed(seed)  # of the first weights
    model = kind.load(saved[-1], env=env, device="cpu") if saved else new(arguments, env)
    # Every session has luck of its own, told by where it begins: the episodes before a kill do not come again.
    model.set_random_seed(int(np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1)[0]))
    model.set_logger(configure(str(home / "tensorboard"), ["tensorboard"]))
    curve = Curve(home / "curve.csv", model.num_timesteps)
    validation = None
    if arguments.suite:
        trials, seats = ValidationSet(arguments, folder), seats_of(arguments)
        validation = Validation(home, arguments.validate_every, trials, seats, curve, model.num_timesteps)
    progress = Progress(validation or curve, arguments.steps, seed, line)
    left = arguments.steps - model.num_timesteps
    if left > 0:
        callbacks = [Checkpoints(home, arguments.checkpoint_every), curve, *filter(None, [validation]), progress]
        # The library counts ``total_timesteps`` from here on when the count is not reset.
        model.learn(left, callbacks, reset_num_timesteps=False)
        save(model, home)
    kept = checkpoints(home)[-1]
    if validation is not None:
        validation.validate(model)
        kept = checkpoint(home, int(validation.best()[0]))
    model.logger.close()
    env.close()
    shutil.copyfile(kept, home / "model.zip")
    seconds = curve.record.rows[-1][1] if curve.record.rows else 0.0
    return Run(seed, home, seconds, curve.record.rows, validation.rows if validation else [])


def seats_of(arguments: Arguments) -> int:
    """Slots that the agent of a suite is shown."""
    return max(L for suite in arguments.suites for L in capacities_of(suite, arguments.capacities))


def training_env(arguments: Arguments) -> GymVecEnv:
    """The batch of environments to train on: of one scenario, or of whole train splits."""
    if arguments.suite:
        mixed = [
            cell
            for suite in arguments.suites
            for cell in cells(suite, "train", capacities_of(suite, arguments.capacities), arguments.data or None)
        ]
        each = math.ceil(arguments.num_envs / len(mixed))
        return GymVecEnv(World(mixed, [each] * len(mixed), reward=arguments.reward))
    return make_vec_env(
        arguments.env,
        arguments.num_envs,
        scenario=worlds(arguments)[0],
        capacity=arguments.capacity,
        decide_at=arguments.decide_at,
        reward=arguments.reward,
    )


class UnmaskedPPO(IgnoresMasks, PPO):
    """PPO that is told of no masks: what is impossible does what a queue does, and the agent has to find out."""


def new_ppo(arguments: Arguments, env: GymVecEnv) -> MaskablePPO | PPO:
    """An untrained actor and critic."""
    masked = arguments.algo == "maskable-ppo"
    policy, settings = policy_of(arguments.network, arguments.width, masked)
    return (MaskablePPO if masked else UnmaskedPPO)(
        policy,
        env,
        learning_rate=LinearSchedule(arguments.learning_rate, 0.0, 1.0),
        n_steps=arguments.n_steps,
        batch_size=_even(arguments.n_steps * env.num_envs, arguments.batch_size),
        n_epochs=arguments.epochs,
        gamma=arguments.gamma,
        gae_lambda=arguments.gae_lambda,
        ent_coef=arguments.entropy,
        stats_window_size=env.num_envs,
        policy_kwargs=settings,
        device="cpu",
    )


def _even(decisions: int, most: int) -> int:
    """The largest batch size up to ``most`` that divides the decisions: no update ends with a noisy rest of a batch."""
    batches = -(-decisions // most)
    while decisions % batches:
        batches += 1
    return decisions // batches


def new_dqn(arguments: Arguments, env: GymVecEnv) -> MaskedDQN:
    """An untrained Q network. It sees each decision as often as PPO (``epochs`` times), in smaller batches and steps.

    Little is explored: a message dropped at random is missing for the rest of the episode.
    """
    batch = max(1, arguments.batch_size // 4)
    steps = max(1, arguments.n_steps // 16)
    return MaskedDQN(
        MaskedDQNPolicy,
        env,
        learning_rate=LinearSchedule(arguments.learning_rate / 4, 0.0, 1.0),
        buffer_size=max(REPLAY, env.num_envs),
        learning_starts=4 * batch,
        batch_size=batch,
        gamma=arguments.gamma,
        train_freq=(steps, "step"),
        gradient_steps=max(1, arguments.epochs * steps * env.num_envs // batch),
        target_update_interval=max(8 * batch, env.num_envs),
        exploration_initial_eps=0.1,
        exploration_final_eps=0.01,
        exploration_fraction=0.5,
        stats_window_size=env.num_envs,
        policy_kwargs=dqn_policy_of(arguments.network, arguments.width),
        device="cpu",
    )


REPLAY = 100_000
"""Decisions; at 32 slots they take about 250 MB."""

LEARNERS: dict[str, tuple[Any, Callable[[Arguments, GymVecEnv], Any]]] = {
    "maskable-ppo": (MaskablePPO, new_ppo),
    "ppo": (UnmaskedPPO, new_ppo),
    "dqn": (MaskedDQN, new_dqn),
}
"""Algorithm -> (its class, a new one)."""


def load(arguments: Arguments, run: Run) -> Any:
    """The agent that the run kept."""
    torch.set_num_threads(1)  # on batches this small, more only wait for one another
    return LEARNERS[arguments.algo][0].load(run.model, device="cpu")


def _test(arguments: Arguments, run: Run, trials: Trials) -> list[Row]:
    agent: Agent = load(arguments, run)
    return trials.rows_of(agent, seats_of(arguments), f"agent ({arguments.algo})", run.seed)


def _evolve(arguments: Arguments, folder: Path, seed: int, line: int = 0) -> Run:
    return Run(seed, folder / f"seed-{seed}", *evolution.train(arguments, folder, seed, line), evolution.MODEL)


def _test_evolved(arguments: Arguments, run: Run, trials: Trials) -> list[Row]:
    return trials.rows_under(load_policy(run.model), f"agent ({arguments.algo})", run.seed)


ALGORITHMS = {name: Algorithm(train_seed, _test) for name in LEARNERS} | {
    "evolution": Algorithm(_evolve, _test_evolved, evolution.MODEL, "that of AFR or Drop Oldest")
}
"""What ``--algo`` can name."""

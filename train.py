"""Train an agent and compare it with the fixed policies: ``python train.py``, or ``--help`` for all settings.

Results are in runs/NAME/. After a kill, the same command with ``--resume`` goes on from the last checkpoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Arguments:
    """Train an agent on a bufgym environment, or on a whole suite, and evaluate it on held-out episodes."""

    env: str = "bufgym/Uplink-v0"
    """Gymnasium id."""
    suite: str = ""
    """Train on this suite's train split instead (all its scenarios and capacities at once), keep what is best on its
    validation split, and report on its test split; the agent is asked at every arrival. Several, as in a,b: on all of
    them at once. A suite of many topics (topics-v1) makes a scheduler, one of a fleet (fleet-v1) an agent
    that all its robots share."""
    data: str = ""
    """Folder of recordings, for suites that need one."""
    capacities: str = ""
    """L of a suite's episodes, such as 5,10,25; by default the suite's own."""
    algo: Literal["maskable-ppo", "ppo", "dqn", "evolution"] = "maskable-ppo"
    """PPO with action masks, PPO without, double DQN with masks, or CMA-ES over whole episodes (suites only)."""
    sees: Literal["motion", "time"] = "motion"
    """What an evolved agent sees: odometry as well, or the clock alone."""
    fields: str = ""
    """Fields that an evolved agent reads, such as rank,motion_merged,stalled; by default those of --sees."""
    hidden: int = 0
    """Hidden units of an evolved agent; with none, its scores are linear in what the context makes of the slots."""
    still_hidden: int = 6
    """The same for its scorer of links that stand still (``warm_up``)."""
    name: str = ""
    """Folder under runs/; by default the next free one (with --resume: the last one) of train-1, train-2, ..."""
    resume: bool = False
    """Go on from the run's last checkpoint."""
    seeds: int = 1
    """Train this many agents, each in a process of its own."""
    seed: int = 0
    """The first seed."""
    steps: int = 1_500_000
    """Decisions to learn from, for each seed."""
    capacity: int = 8
    """L, messages (without a suite)."""
    size_bytes: int = 500_000
    """Mean message size (uplink only); 500 kB at 30 Hz is 1.5 times what the shipped traces carry."""
    duration_s: float = 30.0
    """Length of an episode (uplink only)."""
    decide_at: Literal["overflow", "arrival"] = "overflow"
    """When the agent is asked: only when the buffer is full, or at every arrival."""
    reward: Literal["retained", "delivered"] = "retained"
    network: Literal["slots", "plain"] = "slots"
    """One small network for every slot, or one over all numbers at once."""
    width: int = 32
    """Hidden units a layer."""
    num_envs: int = 256
    n_steps: int = 128
    """Steps in each environment between updates."""
    batch_size: int = 4096
    epochs: int = 4
    """Passes over each batch of experience."""
    learning_rate: float = 2e-3
    """At the start; falls linearly to 0."""
    gamma: float = 0.9
    """``retained`` pays at once what a decision costs, so a short sight suffices and keeps the noise of motion out."""
    gae_lambda: float = 0.9
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    warm_up: int = 0
    """Decisions for which evolution first learns a scorer of its own for links that stand still, from interruptions
    alone (their mean over T is exact and cheap); afterwards the one for all other links, from the other suites."""
    checkpoint_every: int = 250_000
    """Steps."""
    validate_every: int = 250_000
    """Steps (with a suite)."""
    validation_episodes: int = 300
    """About so many in each validation, over all scenarios and capacities."""
    test_seeds: int = 0
    """Test episodes on each trace of a suite; 0: as many as the suite says."""
    episodes: int = 200
    """Held-out episodes in the evaluation (without a suite)."""

    @property
    def suites(self) -> tuple[str, ...]:
        """Those that ``suite`` names."""
        return tuple(filter(None, self.suite.split(",")))


def main(arguments: Arguments | None = None) -> None:
    """Train, evaluate, report."""
    if arguments is None:
        import tyro

        arguments = tyro.cli(Arguments)
    # Not before the arguments are known to be good: torch takes seconds to load.
    from agents import fleets, report, scheduling, training
    from bufgym.errors import BufgymError

    try:
        special = next((kind for kind in (scheduling, fleets) if kind.wanted(arguments)), None)
        folder = training.prepare(arguments)
        if special is not None:
            special.train_and_report(arguments, folder)
            return
        runs = training.train_all(arguments, folder)
        (report.report_suites if arguments.suite else report.evaluate_and_report)(arguments, folder, runs)
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()

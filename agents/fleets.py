"""One agent for a whole fleet: the same slot scorer decides on every robot's buffer, above AFR for the team.

The robots of a cell share its capacity, so what one sends another cannot. Each still sees its own buffer alone. By
evolution a candidate runs on all robots of several cells; its fitness is the team QoI (the mean over robots of H) minus
that of AFR on the same episodes. All candidates of a generation meet the same episodes, the next generation others of
them, and validation episodes say which mean to keep. The search begins with the agent that ships with bufgym, which
learned on a link of its own; it may read more of the link (``MORE``) and learn to spare it (``THRIFT``).

    python train.py --suite fleet-v1 --algo evolution --seeds 5 --steps 24000000 --validate-every 4000000

MaskablePPO learns one set of weights from every robot as a row of a batch (``FleetVecEnv``), each robot paid for its
own information, at the middle one of the suite's capacities; scoring slots, its agent serves the others too.

    python train.py --suite fleet-v1 --algo maskable-ppo --steps 1000000 --validate-every 100000
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from agents.callbacks import Between, Checkpoints, Curve, Progress, checkpoints, save, seed_bar
from agents.evolution import MEMORY, MODEL, Search, fields_of, start
from agents.export import weights_of
from agents.fleet_grounds import PARTS, Ground, Validation, gain, samples, suite_of
from agents.seeds import conclude, each_seed, seeds_of
from agents.training import new_ppo
from bufgym import policies
from bufgym.benchmark import fleets
from bufgym.benchmark.fleets import ROWS
from bufgym.benchmark.fleets_summary import plain, summary
from bufgym.benchmark.rows import Row
from bufgym.envs import FleetVecEnv
from bufgym.errors import BufgymError
from bufgym.files import replaced, shipped
from bufgym.policies import learned, weights
from bufgym.policies.learned import Network, Weights
from bufgym.sb3 import GymVecEnv

if TYPE_CHECKING:
    from train import Arguments

LINK = ("busy", "left", "departures")
MORE = {"motion": ("time_before", "time_merged", *LINK, "arrival_motion_gap"), "time": LINK}
"""What evolution reads besides what the shipped agents do: how the shared link goes on from one message to the next."""
THRIFT = 7.0
"""What evolution takes off the shipped agents' score of accepting where there is room. They accept by a margin so wide
that changing it a little changes nothing, and a search from there stays where it is; with this off, the one with
odometry drops while there is still room and its gain on training episodes is near its largest (docs/fleet.md)."""


def wanted(arguments: Arguments) -> bool:
    """Whether these arguments ask for a fleet's agent; an error if they ask for more than that."""
    asked = [suite for suite in arguments.suites if suite in fleets.SUITES]
    if asked and (len(arguments.suites) > 1 or arguments.algo not in LEARN):
        raise BufgymError(f"suite {asked[0]}: a fleet's agent learns from one suite alone, by {' or '.join(LEARN)}")
    if asked and arguments.algo == "maskable-ppo" and arguments.network != "slots":
        raise BufgymError(f"network = {arguments.network!r}: a fleet's agent scores slots")
    return bool(asked)


# --- training --------------------------------------------------------------------------------------------------------


def begin(arguments: Arguments, seed: int) -> Weights:
    """The agent that ships with bufgym, less ready to accept; where fields or hidden units are asked for, greed."""
    if arguments.fields or arguments.hidden:
        return start(fields_of(arguments), arguments.hidden, np.random.default_rng(seed))
    agents = shipped("agents", "agents/pretrained", "*.safetensors")
    made = widened(weights.read(agents[f"learned-{arguments.sees}"])[0], MORE[arguments.sees])
    made.accept.bias[:] -= THRIFT
    return made


def widened(given: Weights, more: tuple[str, ...]) -> Weights:
    """The same agent, which reads these fields as well but makes nothing of them yet."""
    made = Weights((*given.fields, *more), _padded(given.drop, len(more)), _padded(given.accept, len(more)))
    mix = np.zeros((len(made.context), len(made.slot)), np.float32)
    if given.mix is not None:
        rows, columns = map(made.context.index, given.context), map(made.slot.index, given.slot)
        mix[np.ix_(list(rows), list(columns))] = given.mix
    return replace(made, mix=mix, still=widened(given.still, more) if given.still else None)


def _padded(given: Network, more: int) -> Network:
    """With so many inputs more, all of no weight."""
    layers = list(given.layers)
    if layers:
        weight, bias = layers[0]
        layers[0] = np.pad(weight, ((0, more), (0, 0))), bias
    return replace(given, skip=np.pad(given.skip, (0, more)), bias=given.bias.copy(), layers=tuple(layers))


def evolve(arguments: Arguments, folder: Path, seed: int, line: int = 0) -> tuple[float, float]:
    """Evolve one seed until ``arguments.steps`` decisions were rolled out, from its last checkpoint if there is one.

    Returns:
        (gain over AFR on validation, seconds of training).
    """
    home = folder / f"seed-{seed}"
    home.mkdir(exist_ok=True)
    saved = home / "evolution.pkl"  # one's own run alone: pickles run code when they are read
    parts = samples(suite_of(arguments), seed)
    search = pickle.loads(saved.read_bytes()) if saved.exists() else Search.of(begin(arguments, seed), False, seed)
    validation = Validation(arguments, home, seed, search.steps)
    began = time.perf_counter() - search.seconds
    bar = seed_bar(arguments.steps, search.steps, seed, line)
    while True:
        if validation.due(search.steps):
            validation.judge(search.mean, search.steps, search.seconds)
            bar.set_postfix_str(validation.told(), refresh=False)
        if search.steps >= arguments.steps:
            break
        generation(search, parts[search.generations % PARTS])
        search.seconds = time.perf_counter() - began
        with replaced(saved) as unfinished:
            unfinished.write_bytes(pickle.dumps(search))
        bar.update(search.steps - bar.n)
    bar.close()
    return validation.best, search.seconds


def generation(search: Search, grounds: Sequence[Ground]) -> None:
    """Ask, try every candidate on these grounds, and tell."""
    vectors = search.es.ask()
    search.es.tell(vectors, [-gain(learned.policy("fleet", search.weights(v)), grounds) for v in vectors])
    search.average = search.average + (search.es.mean - search.average) / MEMORY
    search.steps += sum(ground.decisions for ground in grounds) * len(vectors)
    search.generations += 1


class Judged(Between):
    """Validation between stable-baselines3's updates."""

    def __init__(self, validation: Validation, curve: Curve) -> None:
        super().__init__()
        self.validation, self.curve = validation, curve

    def _on_rollout_start(self) -> None:
        if self.validation.due(self.model.num_timesteps):
            self.judge()

    def judge(self) -> None:
        model = self.model
        assert isinstance(model, MaskablePPO)
        self.validation.judge(weights_of(model), model.num_timesteps, self.curve.spent())


def learn(arguments: Arguments, folder: Path, seed: int, line: int = 0) -> tuple[float, float]:
    """The same by MaskablePPO, every robot a row; from the last checkpoint if there is one."""
    torch.set_num_threads(1)
    home = folder / f"seed-{seed}"
    home.mkdir(exist_ok=True)
    env = training_env(arguments)
    saved = checkpoints(home)
    torch.manual_seed(seed)
    model = MaskablePPO.load(saved[-1], env=env, device="cpu") if saved else new_ppo(arguments, env)
    assert isinstance(model, MaskablePPO)
    # Every session has luck of its own, told by where it begins: the episodes before a kill do not come again.
    model.set_random_seed(int(np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1)[0]))
    model.set_logger(Logger(None, []))
    curve = Curve(home / "curve.csv", model.num_timesteps)
    validation = Validation(arguments, home, seed, model.num_timesteps)
    judged, progress = Judged(validation, curve), Progress(curve, arguments.steps, seed, line)
    left = arguments.steps - model.num_timesteps
    if left > 0:
        callbacks: list[BaseCallback] = [Checkpoints(home, arguments.checkpoint_every), curve, judged, progress]
        model.learn(left, callbacks, reset_num_timesteps=False)
        save(model, home)
    if validation.due(model.num_timesteps):
        judged.judge()
    env.close()
    return validation.best, curve.record.rows[-1][1] if curve.record.rows else 0.0


def training_env(arguments: Arguments) -> GymVecEnv:
    """Cells of the suite's robots, about ``num_envs`` rows in all, at its middle capacity."""
    suite = suite_of(arguments)
    return GymVecEnv(
        FleetVecEnv(
            max(1, arguments.num_envs // suite.robots),
            suite.robots,
            suite.uplink("train"),
            suite.capacities[len(suite.capacities) // 2],
            reward="own",
            term=arguments.reward,
            autoreset_mode="SameStep",
        )
    )


LEARN: dict[str, Callable[[Arguments, Path, int, int], tuple[float, float]]] = {
    "evolution": evolve,
    "maskable-ppo": learn,
}
"""Algorithm -> (arguments, the run's folder, seed, line of its progress bar) -> (gain on validation, seconds)."""


def train_and_report(arguments: Arguments, folder: Path) -> None:
    """All seeds, each in a process of its own if there are several; then every agent on the test split."""
    seeds, found = seeds_of(arguments), each_seed(LEARN[arguments.algo], arguments, folder)
    rows = test_rows(arguments, folder, seeds)
    best = seeds[int(np.argmax([reached for reached, _ in found]))]
    conclude(folder, MODEL, best, [seconds for _, seconds in found], rows, ROWS, plain(summary(rows)))


def test_rows(arguments: Arguments, folder: Path, seeds: Sequence[int]) -> list[Row]:
    """Each seed's agent and all fixed policies on the suite's test split."""
    agents = [replace(weights.load(folder / f"seed-{seed}" / MODEL), name=f"agent (seed {seed})") for seed in seeds]
    rivals = [policies.get(name) for name in fleets.default_policies()]
    suite = suite_of(arguments)
    parts = fleets.suite_parts(suite, "test", arguments.test_seeds or None)
    return fleets.run_parts([*agents, *rivals], parts, suite.capacities, progress=True)

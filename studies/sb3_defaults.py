"""How far the trainers of stable-baselines3 come by their own defaults: the curves of results/trainers.md.

python -m studies.sb3_defaults --trainers PPO DQN A2C MaskablePPO --reward regret --steps 200000
python -m studies.sb3_defaults --reward paired --repeat 3 --rows 8 --seeds 0 1 2 3 4 5 6 7 8 9 --steps 300000
python -m studies.sb3_defaults --curves studies/sb3_defaults.csv --figure docs/figures/sb3-defaults.svg

No hyperparameter is set, of the trainer or the environment, but for those that a command names. The score is that of
the most likely actions on fixed episodes that training does not draw, 0 for Drop Oldest and 1 for the clairvoyant. Each
evaluation is a line of the file of curves at once, so that a run cut short shows what it had. The same command goes on
where it was cut: a seed that is complete in the file stays, one that was cut is made anew. An action that holds for
several decisions does so in training alone; every decision is scored.
"""

from __future__ import annotations

import csv
import io
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
import torch
from matplotlib.figure import Figure
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback

from agents.constants import UNTAUGHT
from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.benchmark.bootstrap import RESAMPLES, SEED, interval, stream, times_drawn
from bufgym.benchmark.tasks import QueueTask
from bufgym.oracle import normalised_score
from bufgym.oracle.measure import BASELINE
from bufgym.sb3 import make_vec_env
from bufgym.sb3.networks import takes_masks
from bufgym.scenario.numbered import draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.utils.files import write_text
from studies.page import command, table, written

TRAINERS: dict[str, Any] = {"PPO": PPO, "DQN": DQN, "A2C": A2C, "MaskablePPO": MaskablePPO}
RULES = {name: policies.get(name) for name in ("afr", "target-gap", "gap-price")}
RULES |= {policy.name: policy for policy in UNTAUGHT}
FIRST_SEED = 2_000_000_000  # of the episodes for evaluation
ROLLOUT = 16_384  # most steps between two updates of any trainer
Trainer = Literal["PPO", "DQN", "A2C", "MaskablePPO"]


class Task(NamedTuple):
    """An environment to train in, and the episodes to evaluate on."""

    env: str
    training: dict[str, Any]
    evaluation: dict[str, Any]


def task_of(name: str, data: str | None) -> Task:
    """``Uplink-v1``, or a suite by its name: trained on its training links, evaluated on its test links."""
    if name == "lte":
        return Task("bufgym/Uplink-v1", {}, {})
    suite = {"suite": name, "data": data}
    return Task("bufgym/Suite-v1", {**suite, "split": "train"}, {**suite, "split": "test"})


@dataclass(frozen=True)
class Run:
    """One seed of one trainer; its fields are columns of the file of curves."""

    trainer: str
    reward: str
    actions: str
    rows: int
    task: str
    capacity: int
    repeat: int = 1
    seed: int = field(compare=False, default=0)

    @property
    def label(self) -> str:
        """Everything but the seed, as far as it is not usual."""
        unusual = [f"{self.rows} rows"] * (self.rows != 1) + [self.task] * (self.task != "lte")
        unusual += [f"L = {self.capacity}"] * (self.capacity != 8) + [self.actions] * (self.actions != "candidates")
        unusual += [f"held for {self.repeat}"] * (self.repeat != 1)
        return ", ".join([self.trainer, self.reward, *unusual])


LINE = (*Run.__dataclass_fields__, "steps", "score", "cpu_s")


class Model(Protocol):
    """What chooses actions for a batch of observations, as models of stable-baselines3 do."""

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        """Actions int64[n], and a state that nobody reads."""


class Episodes:
    """Fixed episodes of a task, and the scores of models and rules on them."""

    def __init__(self, count: int, task: Task | None = None, capacity: int = 8) -> None:
        self._task, self._capacity = task or task_of("lte", None), capacity
        named = gym.spec(self._task.env).kwargs["scenario"]
        self._scenario: Any = scenarios.get(named, **self._task.evaluation)
        self._episodes = [draw(self._scenario, FIRST_SEED + i) for i in range(count)]
        best = (QueueTask().best(episode, capacity, self._scenario).qoi for episode in self._episodes)
        self._best = math.fsum(best)
        self._base = self._qoi_of_rule(BASELINE)

    def of_model(self, model: Model, actions: str = "candidates") -> float:
        """The score of a model's most likely actions."""
        n = len(self._episodes)
        options: dict[str, Any] = {"actions": actions, "observation": "flat", "info": "mask", "reward": "retained"}
        envs = gym.make_vec(self._task.env, n, capacity=self._capacity, **options, **self._task.evaluation)
        observation, info = envs.reset(seed=0, options={"episodes": self._episodes})
        qoi, over = np.zeros(n), np.zeros(n, np.bool_)
        while not over.all():
            masks: Any = {"action_masks": info["action_mask"]} if takes_masks(model) else {}
            action = model.predict(observation, deterministic=True, **masks)[0]
            observation, _, terminated, _, info = envs.step(action)
            ended = terminated & ~over
            if ended.any():
                qoi[ended] = info["qoi"][ended]
            over |= ended
        return self._score(math.fsum(qoi))

    def of_rule(self, rule: str | policies.Policy) -> float:
        """The score of a registered policy, or of another one."""
        return self._score(self._qoi_of_rule(rule))

    def _qoi_of_rule(self, rule: str | policies.Policy) -> float:
        senders = run(policies.get(rule), self._episodes, self._capacity, self._scenario.value)
        return math.fsum(outcome(senders, i).qoi for i in range(len(self._episodes)))

    def _score(self, qoi: float) -> float:
        return float(normalised_score(qoi, self._base, self._best))


class Curve(BaseCallback):
    """Writes the score after every so many steps."""

    def __init__(self, episodes: Episodes, run: Run, every: int, out: Path) -> None:
        super().__init__()
        self._episodes, self._run, self._every, self._out = episodes, run, every, out
        self._due, self._begun_s = 0, time.process_time()

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._due:
            self.write()
            self._due = (self.num_timesteps // self._every + 1) * self._every
        return True

    def write(self) -> None:
        """Append the model's score now, and the processor time of training so far."""
        spent_s = time.process_time() - self._begun_s
        score = self._episodes.of_model(self.model, self._run.actions)
        columns = (getattr(self._run, name) for name in Run.__dataclass_fields__)
        append(self._out, LINE, (*columns, self.num_timesteps, f"{score:.4f}", f"{spent_s:.1f}"))
        self._begun_s = time.process_time() - spent_s  # evaluations do not count


def append(out: Path, header: Sequence[str], line: Sequence[Any]) -> None:
    """Append a line to a CSV file, which begins with its header."""
    begins = not out.exists()
    with out.open("a", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([header] * begins + [line])


def train(run: Run, task: Task, steps: int, curve: Curve) -> None:
    """Train one seed with the trainer's defaults."""
    settings: dict[str, Any] = {"actions": run.actions, "observation": "flat", "info": "mask", "reward": run.reward}
    settings["repeat"] = run.repeat
    envs = make_vec_env(task.env, run.rows, capacity=run.capacity, **settings, **task.training)
    TRAINERS[run.trainer]("MlpPolicy", envs, seed=run.seed, device="cpu").learn(steps, curve)
    curve.write()
    envs.close()


Point = tuple[int, float, float]
"""Steps, score, and processor seconds of training."""


def read(curves: Path) -> dict[Run, dict[int, list[Point]]]:
    """Run -> seed -> points in the order of the file; a run's key is that of its first seed."""
    found: dict[Run, dict[int, list[Point]]] = {}
    with curves.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            run = run_of(line)
            point = (int(line["steps"]), float(line["score"]), float(line["cpu_s"]))
            found.setdefault(run, {}).setdefault(run.seed, []).append(point)
    return found


def run_of(line: dict[str, str]) -> Run:
    """The run that a line of the file of curves is about."""
    numbers = {name: int(line[name]) for name in ("rows", "capacity", "repeat", "seed")}
    return Run(**{name: line[name] for name in ("trainer", "reward", "actions", "task")}, **numbers)  # type: ignore[arg-type]


def forget(curves: Path, run: Run) -> None:
    """Take the lines of this seed, which was cut, out of the file."""
    with curves.open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    kept = [line for line in lines if (run_of(line), int(line["seed"])) != (run, run.seed)]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([LINE, *(line.values() for line in kept)])
    write_text(curves, text.getvalue())


def summary(curves: Path, steps: int, rules: Mapping[str, float]) -> list[str]:
    """A table: each seed's score at the last evaluation within so many steps and one rollout, and their mean.

    The interval of the mean is for other seeds on the same episodes; one seed has none. Rules and constant actions
    stand below, best first.
    """
    rows = []
    for one, of_seed in read(curves).items():
        last = [[point for point in curve if point[0] <= steps + ROLLOUT][-1] for curve in of_seed.values()]
        scores, cpu_s = np.array([score for _, score, _ in last]), [seconds for *_, seconds in last]
        n = len(scores)
        drawn = times_drawn(n, RESAMPLES, stream(SEED, one.label)) @ scores / n
        mean = written(interval(drawn, n, within=(-math.inf, 1)), ".2f")
        rows.append((one.label, mean, ", ".join(f"{score:.2f}" for score in scores), f"{np.median(cpu_s):.0f}"))
    rows += [(name, f"{rules[name]:.2f}", "", "") for name in sorted(rules, key=lambda name: -rules[name])]
    return table(("settings", f"mean after {steps:,} steps [95 %, over seeds]", "seeds", "CPU s"), rows)


def draw_curves(curves: Path, rules: dict[str, float], out: Path) -> None:
    """A thin line for each seed, the mean of those that ran longest, and the rules as levels; a colour for each run."""
    figure = Figure(figsize=(7, 4.4), layout="constrained")
    axes = figure.add_subplot(xlabel="steps", ylabel="score", ylim=(0.3, 0.8))
    for k, (one, of_seed) in enumerate(read(curves).items()):
        scores = [{steps: score for steps, score, _ in curve} for curve in of_seed.values()]
        for score_at in scores:
            axes.plot(*zip(*score_at.items(), strict=True), color=f"C{k}", alpha=0.3, linewidth=0.7)
        longest = [score_at for score_at in scores if max(score_at) >= 0.9 * max(map(max, scores))]
        common = sorted(set.intersection(*map(set, longest)))
        mean = [float(np.mean([score_at[steps] for score_at in longest])) for steps in common]
        seeds = f", {len(longest)} seeds" * (len(longest) > 1)
        axes.plot(common, mean, color=f"C{k}", linewidth=1.8, label=one.label + seeds)
    at_level: dict[float, list[str]] = {}
    for name, score in rules.items():
        at_level.setdefault(round(score, 2), []).append(name)  # closer ones would be written over each other
    for score, names in at_level.items():
        axes.axhline(score, color="black", linewidth=0.8, linestyle=":")
        axes.annotate(
            ", ".join(names), (1, score), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8
        )
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    figure.savefig(out)


def page(
    trainers: Sequence[Trainer] = ("PPO",),
    reward: str = "retained",
    actions: str = "candidates",
    rows: int = 1,
    task: str = "lte",
    capacity: int = 8,
    repeat: int = 1,
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    steps: int = 100_000,
    every: int = 10_000,
    episodes: int = 40,
    data: str | None = None,
    curves: Path = Path("runs/sb3_defaults.csv"),
    figure: Path | None = None,
) -> None:
    """Train, or with ``figure`` draw the curves and print their table."""
    torch.set_num_threads(1)
    of_task = task_of(task, data)
    fixed = Episodes(episodes, of_task, capacity)
    rules = {name: fixed.of_rule(rule) for name, rule in RULES.items()}
    print(", ".join(f"{name} {score:.3f}" for name, score in rules.items()), flush=True)
    if figure is not None:
        draw_curves(curves, rules, figure)
        print(*summary(curves, steps, rules), sep="\n")
        return
    curves.parent.mkdir(exist_ok=True)
    for seed in seeds:
        for trainer in trainers:
            one = Run(trainer, reward, actions, rows, task, capacity, repeat, seed)
            done = read(curves).get(one, {}).get(seed, []) if curves.exists() else []
            if not any(reached >= steps for reached, *_ in done):
                if done:
                    forget(curves, one)
                train(one, of_task, steps, Curve(fixed, one, every, curves))


if __name__ == "__main__":
    command(page)

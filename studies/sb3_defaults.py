"""How far PPO comes on ``Uplink-v0`` with the defaults of stable-baselines3: the curve of docs/guide/trainers.md.

python -m studies.sb3_defaults --settings default --seeds 0 1 2 3 4 --steps 100000
python -m studies.sb3_defaults --curves studies/sb3_defaults.csv --figure docs/figures/sb3-defaults.svg

The score is that of the most likely actions on fixed episodes that training does not draw, 0 for Drop Oldest and 1 for
the clairvoyant. Each evaluation is a line of the file of curves at once, so that a run cut short keeps what it had.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.benchmark.tasks import QueueTask
from bufgym.ground.errors import unknown
from bufgym.oracle import BASELINE, normalised_score
from bufgym.sb3 import make_vec_env
from bufgym.scenario.numbered import draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from studies.page import command, table

ENV, CAPACITY, RULES = "bufgym/Uplink-v0", 8, ("afr", "target-gap", "gap-price")
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "scaled": {"reward_scale": "episode"},
    "rule": {"fields": "rule"},
    "8 rows": {"n_envs": 8},
    "8 rows, rule": {"n_envs": 8, "fields": "rule"},
    "8 rows, guided": {"n_envs": 8, "actions": "guided", "fields": "guided"},
}
"""Name -> arguments of ``make_vec_env``; those of PPO are never changed."""
FIRST_SEED = 2_000_000_000  # of the episodes for evaluation
ROLLOUT = 16_384  # most steps between two updates of any settings
LINE = ("settings", "seed", "steps", "score")


class Model(Protocol):
    """What chooses actions for a batch of observations, as models of stable-baselines3 do."""

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        """Actions int64[n], and a state that nobody reads."""


class Episodes:
    """Fixed episodes, and the scores of models and rules on them."""

    def __init__(self, count: int) -> None:
        self._scenario = scenarios.get("lte")
        self._episodes = [draw(self._scenario, FIRST_SEED + i) for i in range(count)]
        self._best = math.fsum(QueueTask().best(episode, CAPACITY, self._scenario).qoi for episode in self._episodes)
        self._base = self._qoi_of_rule(BASELINE)

    def of_model(self, model: Model, settings: dict[str, Any]) -> float:
        """The score of a model's most likely actions."""
        n = len(self._episodes)
        options = {name: value for name, value in settings.items() if name != "n_envs"} | {"info": "mask"}
        envs = gym.make_vec(ENV, n, capacity=CAPACITY, **options)
        observation, _ = envs.reset(seed=0, options={"episodes": self._episodes})
        qoi, over = np.zeros(n), np.zeros(n, np.bool_)
        while not over.all():
            observation, _, terminated, _, info = envs.step(model.predict(observation, deterministic=True)[0])
            ended = terminated & ~over
            if ended.any():
                qoi[ended] = info["qoi"][ended]
            over |= ended
        return self._score(math.fsum(qoi))

    def of_rule(self, name: str) -> float:
        """The score of a registered policy."""
        return self._score(self._qoi_of_rule(name))

    def _qoi_of_rule(self, name: str) -> float:
        senders = run(policies.get(name), self._episodes, CAPACITY, self._scenario.value)
        return math.fsum(outcome(senders, i).qoi for i in range(len(self._episodes)))

    def _score(self, qoi: float) -> float:
        return float(normalised_score(qoi, self._base, self._best))


class Curve(BaseCallback):
    """Writes the score after every so many steps."""

    def __init__(self, episodes: Episodes, settings: str, seed: int, every: int, out: Path) -> None:
        super().__init__()
        self._episodes, self._settings, self._seed, self._every, self._out = episodes, settings, seed, every, out
        self._due = 0

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._due:
            self.write()
            self._due = (self.num_timesteps // self._every + 1) * self._every

    def _on_step(self) -> bool:
        return True

    def write(self) -> None:
        """Append the model's score now."""
        score = self._episodes.of_model(self.model, SETTINGS[self._settings])
        append(self._out, LINE, (self._settings, self._seed, self.num_timesteps, f"{score:.4f}"))


def append(out: Path, header: Sequence[str], line: Sequence[Any]) -> None:
    """Append a line to a CSV file, which begins with its header."""
    begins = not out.exists()
    with out.open("a", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header] * begins + [line])


def train(settings: str, seed: int, steps: int, curve: Curve) -> None:
    """Train one seed with the defaults of stable-baselines3."""
    envs = make_vec_env(ENV, capacity=CAPACITY, info="mask", **SETTINGS[settings])
    PPO("MultiInputPolicy", envs, seed=seed, device="cpu").learn(steps, curve)
    curve.write()
    envs.close()


def read(curves: Path) -> dict[str, dict[int, list[tuple[int, float]]]]:
    """Settings -> seed -> (steps, score) in the order of the file."""
    found: dict[str, dict[int, list[tuple[int, float]]]] = {}
    with curves.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            curve = found.setdefault(line["settings"], {}).setdefault(int(line["seed"]), [])
            curve.append((int(line["steps"]), float(line["score"])))
    return found


def summary(curves: Path, steps: int) -> list[str]:
    """A table: each seed's score at the last evaluation within so many steps and one rollout, and their median."""
    rows = []
    for settings, of_seed in read(curves).items():
        scores = [[score for at, score in curve if at <= steps + ROLLOUT][-1] for curve in of_seed.values()]
        rows.append((settings, f"{np.median(scores):.2f}", ", ".join(f"{score:.2f}" for score in scores)))
    return table(("settings", f"median after {steps:,} steps", "seeds"), rows)


def draw_curves(curves: Path, rules: dict[str, float], out: Path) -> None:
    """A line for each seed, a colour for each of the settings, and the rules as levels."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.add_subplot(xlabel="steps", ylabel="score")
    for k, (settings, of_seed) in enumerate(read(curves).items()):
        for n, curve in enumerate(of_seed.values()):
            axes.plot(*zip(*curve, strict=True), color=f"C{k}", alpha=0.7, label=settings if n == 0 else None)
    for name, score in rules.items():
        axes.axhline(score, color="black", linewidth=0.8, linestyle=":")
        axes.annotate(name, (1, score), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8)
    axes.legend(loc="lower right", frameon=False)
    figure.savefig(out)


def page(
    settings: Sequence[str] = ("default",),
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    steps: int = 100_000,
    every: int = 10_000,
    episodes: int = 40,
    curves: Path = Path("runs/sb3_defaults.csv"),
    figure: Path | None = None,
) -> None:
    """Train, or with ``figure`` draw the curves and print their table."""
    fixed = Episodes(episodes)
    rules = {name: fixed.of_rule(name) for name in RULES}
    print(", ".join(f"{name} {score:.3f}" for name, score in rules.items()), flush=True)
    if figure is not None:
        draw_curves(curves, rules, figure)
        print(*summary(curves, steps), sep="\n")
        return
    curves.parent.mkdir(exist_ok=True)
    for name in settings:
        if name not in SETTINGS:
            raise unknown("settings", name, SETTINGS)
        for seed in seeds:
            train(name, seed, steps, Curve(fixed, name, seed, every, curves))


if __name__ == "__main__":
    command(page)

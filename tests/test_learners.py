"""Learners one by one: what each keeps, how it goes on, and that a new one is a class and its settings."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_cases import Patch
from refusal_cases import refuse
from test_train import LEARNERS, ON
from train_cases import in_a_folder_of_its_own  # noqa: F401

import train
from agents import ppo, runs
from agents.callbacks import checkpoints
from agents.held_out import FixedEpisodes
from agents.learner import Learner, learner_of
from agents.settings import Settings
from agents.tasks import Environment
from bufgym import policies
from bufgym.envs import SenderVectorEnv
from bufgym.policies.ruled_network import RuledWeights, seen
from bufgym.policies.weights import save


@pytest.mark.parametrize("algo", ["ppo", "dqn"])
def test_a_network_is_kept_as_a_policy_that_decides_as_it_does(algo: str) -> None:
    """The same episodes in torch, in the environment, and compiled, as a policy."""
    learner: Any = learner_of(LEARNERS[algo])
    run = learner.train_seed(runs.prepare(LEARNERS[algo]), 0)
    test, model = FixedEpisodes(ON, "test", 3), learner.algorithm.load(run.folder / "model.zip")
    envs = SenderVectorEnv(3, test.scenario, ON.capacity, info="full")
    seen, _ = envs.reset(options={"episodes": test.episodes})
    reached, live = np.zeros(3), np.ones(3, np.bool_)
    while live.any():
        seen, _, ended, _, info = envs.step(model.predict(seen, deterministic=True)[0])
        reached[live & ended] = info["qoi"][live & ended]
        live &= ~ended
    outcomes = test.play(learner.agent(run))
    assert [outcome.qoi for outcome in outcomes] == pytest.approx(reached)
    assert any(outcome.dropped for outcome in outcomes)


FIRST = np.zeros((seen(3), 4), np.float32), np.zeros(4, np.float32)
LAST = np.zeros((4, 6), np.float32), np.array([0, 0, 0, 0, 0, 1], np.float32)
THE_RULE = RuledWeights(3, True, True, "tanh", (FIRST, LAST))
"""Its sixth action is the highest: what gap-price does."""


@dataclasses.dataclass(frozen=True)
class Still(Settings):
    """Keep the start."""

    algo = "still"
    learner = "test_learners:StillTheRule"
    steps: int = 1


class StillTheRule(Learner[Still]):
    """Learns nothing: its agent does what gap-price does."""

    def train_seed(self, folder: Path, seed: int, line: int = 0) -> runs.Run:
        home, objective = folder / f"seed-{seed}", self.objective(folder, seed)
        save(home / runs.MODEL, THE_RULE, self.notes(seed, "still"))
        run = runs.Run(seed, home, 0.0, [], [], objective.best)
        return dataclasses.replace(run, validation=[(0, 0.0, *objective.validate(self.agent(run)))])


def test_a_new_learner_is_a_class_and_its_settings(monkeypatch: Patch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(train, "main", asked.append)
    train.add_command(Still)
    with pytest.raises(SystemExit):
        train.typed(["still", "--capacity=3", "--validation-episodes=2", "--name=tiny"])
    assert asked == [Still(environment=Environment(capacity=3), name="tiny", validation_episodes=2)]
    (run,) = learner_of(asked[0]).train(runs.prepare(asked[0]))
    judges = FixedEpisodes(asked[0].environment, "validation", 2)
    assert run.merit == np.mean([outcome.qoi for outcome in judges.play(policies.get("gap-price"))])
    assert policies.load(run.model).name == "still"


def test_dqn_goes_on_with_its_optimizer_and_a_fresh_replay() -> None:
    arguments = LEARNERS["dqn"]
    folder = runs.prepare(arguments)
    models = []
    for steps in (256, 512):
        learner_of(dataclasses.replace(arguments, steps=steps)).train_seed(folder, 0)
        model = ppo.sb3.DQN.load(checkpoints(folder / "seed-0")[-1])
        counts = {int(state["step"]) for state in model.policy.optimizer.state_dict()["state"].values()}
        assert model.num_timesteps == steps and counts == {model._n_updates}
        models.append(model)
    assert models[1]._n_updates > models[0]._n_updates > 0


def test_batches_divide_the_experience() -> None:
    assert ppo.even_batch(32_768, 4_096) == 4_096
    assert ppo.even_batch(34_560, 4_096) == 3_840  # nine of them: eight would be too large
    assert ppo.even_batch(100, 4_096) == 100
    refuse("batch_size = 4: num_envs x n_steps = 7 decisions", ppo.even_batch, 7, 4)

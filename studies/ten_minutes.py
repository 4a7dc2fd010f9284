"""The score after ten minutes of one core, for each library of examples/trainers that trains a policy.

python -m studies.ten_minutes --library tianshou --minutes 10 --out runs/ten_minutes.csv

Each library has its own PPO, with its defaults or the numbers of its first example, on ``Uplink-v1`` with L = 8. Only
Tianshou has its DQN. Actions are the environment's default, ordered candidates, and all of them are valid. So no
library needs a mask. The reward is ``regret`` unless ``--reward`` names another. The minutes are processor time of the
process and all those below it, so other work on the machine does not matter. Imports and the score itself do not count.
Training is cut wherever it is by then. The score is computed as in ``studies.sb3_defaults``, which needs the extras
``train`` and ``plot`` beside the library.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, NamedTuple

os.environ["OMP_NUM_THREADS"] = "1"  # before any library is imported

import gymnasium as gym
import numpy as np
import psutil
import torch

import bufgym  # noqa: F401  (registers the environments)
from bufgym.utils.errors import unknown
from studies.page import command
from studies.sb3_defaults import Episodes, append

ENV, CAPACITY = "bufgym/Uplink-v1", 8
LINE = ("library", "reward", "minutes", "score")


class TimeIsUp(BaseException):
    """The processor time is used up; no ``Exception``, so that no library catches it."""


class Budget:
    """A block that ends after so much processor time of this process and of those below it."""

    def __init__(self, minutes: float) -> None:
        self.minutes = minutes
        self._began_s = 0.0

    def __enter__(self) -> None:
        self._began_s = _processor_s()
        signal.signal(signal.SIGPROF, self._check)
        signal.setitimer(signal.ITIMER_PROF, 0.5, 0.5)  # again and again: a destructor swallows what is raised in it

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> bool:
        signal.setitimer(signal.ITIMER_PROF, 0)
        print(f"{_processor_s() - self._began_s:.0f} s of processor time", file=sys.stderr)
        return kind is TimeIsUp

    def _check(self, number: int, frame: FrameType | None) -> None:
        if _processor_s() - self._began_s >= 60 * self.minutes:
            raise TimeIsUp


def _processor_s() -> float:
    """Seconds of this process and all below it, ended ones too."""
    root = psutil.Process()
    return sum(sum(process.cpu_times()[:4]) for process in (root, *root.children(recursive=True)))


class Trained(NamedTuple):
    """What a library made: the most likely actions to a batch of observations."""

    act: Callable[[Any], Any]

    def predict(self, observation: Any, deterministic: bool) -> tuple[Any, None]:
        """Actions int64[n], under the name that ``Episodes.of_model`` calls."""
        with torch.no_grad():
            return np.asarray(self.act(observation)), None


class Task(NamedTuple):
    """What each library learns: the environment, with this reward."""

    reward: str

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the environment for training."""
        return {"capacity": CAPACITY, "info": "mask", "reward": self.reward}

    def make(self) -> gym.Env[Any, Any]:
        """One environment."""
        return gym.make(ENV, **self.settings)

    def make_batch(self, n: int) -> gym.vector.VectorEnv[Any, Any, Any]:
        """n rows of the native batch."""
        return gym.make_vec(ENV, n, **self.settings)


def tensor(numbers: Any) -> torch.Tensor:
    """Numbers as float32."""
    return torch.as_tensor(numbers, dtype=torch.float32)


def layers(*widths: int) -> torch.nn.Sequential:
    """Linear layers with tanh between them."""
    linear = [torch.nn.Linear(a, b) for a, b in pairwise(widths)]
    return torch.nn.Sequential(linear[0], *(part for layer in linear[1:] for part in (torch.nn.Tanh(), layer)))


def cleanrl(budget: Budget, task: Task) -> Trained:
    """examples/ppo.py with as many decisions as fit, because its learning rate falls to 0 over them."""
    ppo: Any = import_module("examples.ppo")
    networks: list[Any] = []

    class Network(ppo.Network):  # type: ignore[misc]
        def __init__(self, *sizes: int) -> None:
            super().__init__(*sizes)
            networks.append(self)

    ppo.Network = Network
    with budget:
        ppo.main(ppo.Settings(steps=int(budget.minutes * 600_000), reward=task.reward))
    return Trained(lambda seen: networks[0].actor(tensor(seen)).argmax(dim=-1))


def sbx(budget: Budget, task: Task) -> Trained:
    """The defaults of its PPO."""
    from sbx import PPO

    from bufgym.sb3 import make_vec_env

    model = PPO("MlpPolicy", make_vec_env(ENV, **task.settings))
    with budget:
        model.learn(10**9)
    return Trained(lambda seen: model.predict(seen, deterministic=True)[0])


def torchrl(budget: Budget, task: Task) -> Trained:
    """The loop and the numbers of its tutorial on PPO, without its schedule."""
    from tensordict.nn import TensorDictModule
    from torchrl.collectors import Collector
    from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
    from torchrl.envs import GymWrapper
    from torchrl.modules import ProbabilisticActor, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

    env = GymWrapper(task.make(), categorical_action_encoding=True)
    inputs, actions = env.observation_spec["observation"].shape[-1], env.action_spec.n
    scorer = TensorDictModule(layers(inputs, 256, 256, 256, actions), in_keys=["observation"], out_keys=["logits"])
    actor = ProbabilisticActor(
        scorer,
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        spec=env.action_spec,
        return_log_prob=True,
    )
    critic = ValueOperator(layers(inputs, 256, 256, 256, 1), in_keys=["observation"])
    loss_of = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=1e-4)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    buffer = ReplayBuffer(storage=LazyTensorStorage(1_000), sampler=SamplerWithoutReplacement(), batch_size=64)
    optimizer = torch.optim.Adam(loss_of.parameters(), 3e-4)
    with budget:
        for played in Collector(env, actor, frames_per_batch=1_000, total_frames=-1):
            for _ in range(10):
                advantage(played)
                buffer.extend(played.reshape(-1))
                for _ in range(1_000 // 64):
                    losses = loss_of(buffer.sample())
                    sum(losses[f"loss_{name}"] for name in ("objective", "critic", "entropy")).backward()
                    torch.nn.utils.clip_grad_norm_(loss_of.parameters(), 1.0)
                    optimizer.step()
                    optimizer.zero_grad()
    net = scorer.module
    return Trained(lambda seen: net(tensor(seen)).argmax(dim=-1))


def tianshou(budget: Budget, task: Task) -> Trained:
    """The numbers of the DQN in its README."""
    from tianshou.algorithm import DQN
    from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv
    from tianshou.trainer import OffPolicyTrainerParams
    from tianshou.utils.net.common import Net

    env: Any = task.make()
    space, actions = env.observation_space, env.action_space
    net = Net(state_shape=space.shape, action_shape=actions.n, hidden_sizes=[128, 128, 128])
    policy = DiscreteQLearningPolicy(model=net, action_space=actions, observation_space=space, eps_training=0.1)
    optimizer = AdamOptimizerFactory(lr=1e-3)
    algorithm = DQN(policy=policy, optim=optimizer, gamma=0.9, n_step_return_horizon=3, target_update_freq=320)
    envs = DummyVectorEnv([task.make] * 10)
    collector = Collector(algorithm, envs, VectorReplayBuffer(20_000, 10), exploration_noise=True)
    with budget:
        algorithm.run_training(
            OffPolicyTrainerParams(
                training_collector=collector,
                max_epochs=10**6,
                epoch_num_steps=10_000,
                collection_step_num_env_steps=10,
                update_step_num_gradient_steps_per_sample=0.1,
                test_in_training=False,
            )
        )
    return Trained(lambda seen: net(seen)[0].argmax(dim=-1))


def rllib(budget: Budget, task: Task) -> Trained:
    """The defaults of its PPO."""
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.tune.registry import register_env

    register_env("uplink", lambda _: task.make())
    algorithm = PPOConfig().environment("uplink").env_runners(num_env_runners=0).build_algo()
    with budget:
        while True:
            algorithm.train()
    net = algorithm.get_module()

    def act(seen: Any) -> Any:
        return net.forward_inference({"obs": tensor(seen)})["action_dist_inputs"].argmax(dim=-1)

    return Trained(act)


def skrl(budget: Budget, task: Task) -> Trained:
    """The defaults of its PPO on four environments, as in its examples."""
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.utils.runner.torch import Runner

    hidden = {"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"}
    models = {
        "separate": True,
        "policy": {
            "class": "CategoricalMixin",
            "network": [hidden],
            "output": "ACTIONS",
            "unnormalized_log_prob": True,
        },
        "value": {"class": "DeterministicMixin", "network": [hidden], "output": "ONE"},
    }
    cfg = {"seed": 0, "models": models, "memory": {"class": "RandomMemory", "memory_size": -1}}
    cfg["agent"] = {"class": "PPO", "rollouts": 16}  # its default, which the memory reads here
    cfg["trainer"] = {"class": "SequentialTrainer", "timesteps": 10**9, "headless": True, "environment_info": "log"}
    runner = Runner(wrap_env(task.make_batch(4)), cfg)
    with budget:
        runner.run("train")
    policy = runner.agent.models["policy"]
    return Trained(lambda seen: policy.compute({"observations": tensor(seen)}, role="policy")[0].argmax(-1))


def agilerl(budget: Budget, task: Task) -> Trained:
    """The defaults of its PPO on one native batch of eight, as on our page."""
    from agilerl.algorithms import PPO
    from agilerl.rollouts.on_policy import collect_rollouts

    envs = task.make_batch(8)
    spaces = envs.single_observation_space, envs.single_action_space
    agent = PPO(*spaces, num_envs=8, use_rollout_buffer=True, device="cpu")
    agent.set_training_mode(True)
    with budget:
        while True:
            collect_rollouts(agent, envs)
            agent.learn()
    net = agent.actor
    return Trained(lambda seen: net.head_net.wrapped(net.extract_features(tensor(seen))).argmax(dim=-1))


LIBRARIES: dict[str, Callable[[Budget, Task], Trained]] = {
    "cleanrl": cleanrl,
    "sbx": sbx,
    "torchrl": torchrl,
    "tianshou": tianshou,
    "rllib": rllib,
    "skrl": skrl,
    "agilerl": agilerl,
}


def page(
    library: str,
    reward: str = "regret",
    minutes: float = 10.0,
    out: Path = Path("runs/ten_minutes.csv"),
    episodes: int = 40,
) -> None:
    """Train with one library and append its score to ``out``."""
    if library not in LIBRARIES:
        raise unknown("library", library, LIBRARIES)
    fixed = Episodes(episodes)
    trained: Any = LIBRARIES[library](Budget(minutes), Task(reward))
    score = fixed.of_model(trained)
    print(f"{library}: {score:.3f}")
    out.parent.mkdir(exist_ok=True)
    append(out, LINE, (library, reward, f"{minutes:g}", f"{score:.4f}"))


if __name__ == "__main__":
    command(page)

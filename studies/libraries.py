"""Each library's trainer by its own settings, on one task: what ``studies.ten_minutes`` runs.

A trainer has the defaults of its library or the numbers of the library's first example: PPO, and from stable-baselines3
A2C and DQN, too; Tianshou has its DQN. The task is ``Uplink-v1`` with L = 8 and ordered candidates as actions. All of
them are valid, so no library needs a mask.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib import import_module
from itertools import pairwise
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch

import bufgym  # noqa: F401  (registers the environments)
from studies.sb3_defaults import Model

ENV, CAPACITY = "bufgym/Uplink-v1", 8
HELD = {"cost": 3, "paired": 3}
"""Decisions that an action holds for in training, by the reward; 1 with others."""


class Learner(NamedTuple):
    """A trainer before it begins."""

    train: Callable[[], Any]
    """Trains until it is cut, or for ``Task.minutes``."""
    policy: Callable[[], Model]
    """What it has learned by now, at the start of episodes."""


class Trained:
    """The most likely actions to a batch of observations."""

    def __init__(self, act: Callable[[Any], Any]) -> None:
        self._act = act

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, None]:
        """Actions int64[n], under the name that ``Episodes.of_model`` calls."""
        with torch.no_grad():
            return np.asarray(self._act(observation)), None


class Remembering:
    """A model of stable-baselines3 with a recurrent state, at the start of episodes."""

    def __init__(self, model: Any) -> None:
        self._model, self._state = model, None

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        """Actions int64[n] and the state after them."""
        starts = np.full(len(observation), self._state is None)
        action, self._state = self._model.predict(observation, self._state, starts, deterministic)
        return action, self._state


class Task:
    """What a library learns: the environment with this reward, from this seed, for so many minutes of processor.

    ``check`` is called before each step of each environment.
    """

    def __init__(self, reward: str, seed: int, minutes: float, check: Callable[[], None]) -> None:
        self.seed, self.minutes, self._check = seed, minutes, check
        self.settings: dict[str, Any] = {
            "capacity": CAPACITY,
            "info": "mask",
            "reward": reward,
            "repeat": HELD.get(reward, 1),
        }
        self._made = 0

    def make(self) -> gym.Env[Any, Any]:
        """One environment, which goes on from a seed of its own at each reset."""
        env: gym.Env[Any, Any] = self._seeded(gym.make(ENV, **self.settings))
        return env

    def make_batch(self, n: int, **settings: Any) -> gym.vector.VectorEnv[Any, Any, Any]:
        """n rows of the native batch, likewise."""
        envs = gym.make_vec(ENV, n, **self.settings, **settings)
        seeded: gym.vector.VectorEnv[Any, Any, Any] = self._seeded(envs)
        return seeded

    def fitting(self, steps: int, cpu_s: float) -> int:
        """Decisions that fit into the minutes, for a schedule that needs to know, where ``steps`` took so long."""
        return max(steps, int(60 * self.minutes / cpu_s * steps))

    def watched(self, env: Any) -> Any:
        """The environment, with the check."""
        step = env.step

        def checked(actions: Any) -> Any:
            self._check()
            return step(actions)

        env.step = checked
        return env

    def _seeded(self, env: Any) -> Any:
        env.reset(seed=1_000 * self.seed + self._made)
        self._made += 1
        return self.watched(env)


def tensor(numbers: Any) -> torch.Tensor:
    """Numbers as float32."""
    return torch.as_tensor(numbers, dtype=torch.float32)


def layers(*widths: int) -> torch.nn.Sequential:
    """Linear layers with tanh between them."""
    linear = [torch.nn.Linear(a, b) for a, b in pairwise(widths)]
    return torch.nn.Sequential(linear[0], *(part for layer in linear[1:] for part in (torch.nn.Tanh(), layer)))


def forever(update: Callable[[], object]) -> None:
    """Update again and again."""
    while True:
        update()


def stable_baselines3(package: str, name: str) -> Callable[[Task], Learner]:
    """The defaults of one of its trainers, on one environment. DQN's exploration falls over the first tenth."""

    def learner(task: Task) -> Learner:
        from bufgym.sb3 import make_vec_env

        trainer = getattr(import_module(package), name)
        network = "MlpLstmPolicy" if name == "RecurrentPPO" else "MlpPolicy"

        def new() -> Any:
            envs = task.watched(make_vec_env(ENV, **task.settings))
            return trainer(network, envs, seed=task.seed, device="cpu")

        steps = 10**9
        if name == "DQN":
            new().learn(1_000)  # what is slower at first
            began_s = time.process_time()
            new().learn(4_000)
            steps = task.fitting(4_000, time.process_time() - began_s)
        model = new()
        return Learner(lambda: model.learn(steps), lambda: Remembering(model) if name == "RecurrentPPO" else model)

    return learner


def cleanrl(task: Task) -> Learner:
    """examples/ppo.py on all links, with as many decisions as fit, because its learning rate falls to 0 over them."""
    ppo: Any = import_module("examples.ppo")
    networks: list[Any] = []
    make_test = ppo.make

    class Network(ppo.Network):  # type: ignore[misc]
        def __init__(self, *sizes: int) -> None:
            super().__init__(*sizes)
            networks.append(self)

    def make(traces: Any, n: int, settings: Any, reward: str, mode: Any) -> Any:
        if traces is ppo.TRAIN:
            return task.make_batch(n, autoreset_mode=mode)
        return make_test(traces, n, settings, reward, mode)

    def train(steps: int) -> float:
        return float(ppo.main(ppo.Settings(steps=steps, seed=task.seed, test_seeds=1))["cpu_s"])

    ppo.Network, ppo.make = Network, make
    steps = task.fitting(40_960, train(40_960))
    return Learner(lambda: train(steps), lambda: Trained(lambda seen: networks[-1].actor(tensor(seen)).argmax(dim=-1)))


def sbx(task: Task) -> Learner:
    """The defaults of its PPO."""
    from sbx import PPO

    from bufgym.sb3 import make_vec_env

    model = PPO("MlpPolicy", task.watched(make_vec_env(ENV, **task.settings)), seed=task.seed)
    return Learner(lambda: model.learn(10**9), lambda: Trained(lambda seen: model.predict(seen, deterministic=True)[0]))


def torchrl(task: Task) -> Learner:
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

    def train() -> None:
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
    return Learner(train, lambda: Trained(lambda seen: net(tensor(seen)).argmax(dim=-1)))


def tianshou(task: Task) -> Learner:
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
    how = OffPolicyTrainerParams(
        training_collector=collector,
        max_epochs=10**6,
        epoch_num_steps=10_000,
        collection_step_num_env_steps=10,
        update_step_num_gradient_steps_per_sample=0.1,
        test_in_training=False,
    )
    act = Trained(lambda seen: net(seen)[0].argmax(dim=-1))
    return Learner(lambda: algorithm.run_training(how), lambda: act)


def rllib(task: Task) -> Learner:
    """The defaults of its PPO."""
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.tune.registry import register_env

    ray.init(num_cpus=1, include_dashboard=False)  # fewer processes; it trains in this one
    register_env("uplink", lambda _: task.make())
    config = PPOConfig().environment("uplink").env_runners(num_env_runners=0).debugging(seed=task.seed)
    algorithm = config.build_algo()
    net = algorithm.get_module()

    def act(seen: Any) -> Any:
        return net.forward_inference({"obs": tensor(seen)})["action_dist_inputs"].argmax(dim=-1)

    return Learner(lambda: forever(algorithm.train), lambda: Trained(act))


def skrl(task: Task) -> Learner:
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
    cfg = {"seed": task.seed, "models": models, "memory": {"class": "RandomMemory", "memory_size": -1}}
    cfg["agent"] = {"class": "PPO", "rollouts": 16}  # its default, which the memory reads here
    cfg["trainer"] = {"class": "SequentialTrainer", "timesteps": 10**9, "headless": True, "environment_info": "log"}
    runner = Runner(wrap_env(task.make_batch(4)), cfg)
    policy = runner.agent.models["policy"]
    act = Trained(lambda seen: policy.compute({"observations": tensor(seen)}, role="policy")[0].argmax(-1))
    return Learner(lambda: runner.run("train"), lambda: act)


def agilerl(task: Task) -> Learner:
    """The defaults of its PPO on one native batch of eight, as on our page."""
    from agilerl.algorithms import PPO
    from agilerl.rollouts.on_policy import collect_rollouts

    envs = task.make_batch(8)
    spaces = envs.single_observation_space, envs.single_action_space
    agent = PPO(*spaces, num_envs=8, use_rollout_buffer=True, device="cpu")
    agent.set_training_mode(True)

    def update() -> None:
        collect_rollouts(agent, envs)
        agent.learn()

    net = agent.actor
    act = Trained(lambda seen: net.head_net.wrapped(net.extract_features(tensor(seen))).argmax(dim=-1))
    return Learner(lambda: forever(update), lambda: act)


class Library(NamedTuple):
    """A trainer, and where it comes from."""

    title: str
    package: str
    """What is imported, and its row of docs/guide/trainers.md; sb3_contrib comes with stable_baselines3."""
    distribution: str
    learner: Callable[[Task], Learner]


def _sb3(name: str, package: str = "stable_baselines3", distribution: str = "stable-baselines3") -> Library:
    title = f"stable-baselines3, {name}" if package == "stable_baselines3" else f"sb3-contrib, {name}"
    return Library(title, "stable_baselines3", distribution, stable_baselines3(package, name))


LIBRARIES = {
    "sb3-ppo": _sb3("PPO"),
    "sb3-a2c": _sb3("A2C"),
    "sb3-dqn": _sb3("DQN"),
    "sb3-maskable-ppo": _sb3("MaskablePPO", "sb3_contrib", "sb3-contrib"),
    "sb3-recurrent-ppo": _sb3("RecurrentPPO", "sb3_contrib", "sb3-contrib"),
    "cleanrl": Library("CleanRL's style, PPO", "torch", "torch", cleanrl),
    "torchrl": Library("TorchRL, PPO", "torchrl", "torchrl", torchrl),
    "tianshou": Library("Tianshou, DQN", "tianshou", "tianshou", tianshou),
    "rllib": Library("RLlib, PPO", "ray", "ray", rllib),
    "sbx": Library("sbx, PPO", "sbx", "sbx-rl", sbx),
    "skrl": Library("skrl, PPO", "skrl", "skrl", skrl),
    "agilerl": Library("AgileRL, PPO", "agilerl", "agilerl", agilerl),
}
"""Name on the command line -> trainer; those that need no environment of their own first."""

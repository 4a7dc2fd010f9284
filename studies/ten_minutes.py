"""The score after ten minutes of one core, for each library of docs/guide/trainers.md that trains a policy.

python -m studies.ten_minutes --library tianshou --minutes 10 --out runs/ten_minutes.csv

Each library has its own PPO, with its defaults or the numbers of its first example, on ``Uplink-v0`` with L = 8. Only
Tianshou has its DQN, which knows masks. The minutes are processor time of the process and all those below it, so other
work on the machine does not matter; imports and the score itself do not count. Training is cut wherever it is by then.
The score is computed as in ``studies.sb3_defaults``, which needs the extras ``train`` and ``plot`` beside the library.
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
from bufgym.ground.errors import unknown
from studies.page import command
from studies.sb3_defaults import Episodes, append

ENV, CAPACITY = "bufgym/Uplink-v0", 8

FLAT: dict[str, Any] = {"observation": "flat"}
BOOL = FLAT | {"mask_dtype": "bool"}
LINE = ("library", "minutes", "score")


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
    """What a library made: the most likely actions to a batch of observations, under these settings."""

    act: Callable[[Any], Any]
    settings: dict[str, Any]

    def predict(self, observation: Any, deterministic: bool) -> tuple[Any, None]:
        """Actions int64[n], under the name that ``Episodes.of_model`` calls."""
        with torch.no_grad():
            return np.asarray(self.act(observation)), None


def make(**settings: Any) -> gym.Env[Any, Any]:
    """One environment."""
    return gym.make(ENV, capacity=CAPACITY, info="mask", **settings)


def make_batch(n: int, **settings: Any) -> gym.vector.VectorEnv[Any, Any, Any]:
    """n rows of the native batch."""
    return gym.make_vec(ENV, n, capacity=CAPACITY, info="mask", **settings)


def tensor(numbers: Any) -> torch.Tensor:
    """Numbers as float32."""
    return torch.as_tensor(numbers, dtype=torch.float32)


def best(logits: torch.Tensor, mask: Any) -> torch.Tensor:
    """The valid action with the highest logit, int64[n]."""
    return logits.masked_fill(torch.as_tensor(mask) == 0, -torch.inf).argmax(dim=-1)


def layers(*widths: int) -> torch.nn.Sequential:
    """Linear layers with tanh between them."""
    linear = [torch.nn.Linear(a, b) for a, b in pairwise(widths)]
    return torch.nn.Sequential(linear[0], *(part for layer in linear[1:] for part in (torch.nn.Tanh(), layer)))


def cleanrl(budget: Budget) -> Trained:
    """examples/ppo.py with as many decisions as fit, because its learning rate falls to 0 over them."""
    ppo: Any = import_module("examples.ppo")
    networks: list[Any] = []

    class Network(ppo.SlotNetwork):  # type: ignore[misc]
        def __init__(self, *sizes: int) -> None:
            super().__init__(*sizes)
            networks.append(self)

    ppo.SlotNetwork = Network
    with budget:
        ppo.main(ppo.Settings(steps=int(budget.minutes * 1_500_000)))

    def act(seen: Any) -> Any:
        return best(networks[0](*ppo.tensors(seen))[0], seen["action_mask"])

    return Trained(act, {"observation": "slots", "decide_at": "overflow", "mask_in_observation": True})


def sbx(budget: Budget) -> Trained:
    """Its PPO knows no masks."""
    from sbx import PPO

    from bufgym.sb3 import make_vec_env

    model = PPO("MlpPolicy", make_vec_env(ENV, capacity=CAPACITY, info="mask", **FLAT))
    with budget:
        model.learn(10**9)
    return Trained(lambda seen: model.predict(seen, deterministic=True)[0], FLAT)


def torchrl(budget: Budget) -> Trained:
    """The loop and the numbers of its tutorial on PPO, without its schedule; the actor is masked."""
    from tensordict.nn import TensorDictModule
    from torchrl.collectors import Collector
    from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
    from torchrl.envs import GymWrapper
    from torchrl.modules import MaskedCategorical, ProbabilisticActor, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

    settings = BOOL | {"mask_in_observation": True}
    env = GymWrapper(make(**settings), categorical_action_encoding=True)
    inputs, actions = env.observation_spec["observation"].shape[-1], env.action_spec.n
    scorer = TensorDictModule(layers(inputs, 256, 256, 256, actions), in_keys=["observation"], out_keys=["logits"])
    actor = ProbabilisticActor(
        scorer,
        in_keys={"logits": "logits", "mask": "action_mask"},
        distribution_class=MaskedCategorical,
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
    return Trained(lambda seen: best(net(tensor(seen["observation"])), seen["action_mask"]), settings)


def tianshou(budget: Budget) -> Trained:
    """The numbers of the DQN in its README."""
    from tianshou.algorithm import DQN
    from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv
    from tianshou.trainer import OffPolicyTrainerParams
    from tianshou.utils.net.common import Net

    settings = FLAT | {"mask_in_observation": "tianshou"}
    env: Any = make(**settings)
    space, actions = env.observation_space, env.action_space
    net = Net(state_shape=space["obs"].shape, action_shape=actions.n, hidden_sizes=[128, 128, 128])
    policy = DiscreteQLearningPolicy(model=net, action_space=actions, observation_space=space, eps_training=0.1)
    optimizer = AdamOptimizerFactory(lr=1e-3)
    algorithm = DQN(policy=policy, optim=optimizer, gamma=0.9, n_step_return_horizon=3, target_update_freq=320)
    envs = DummyVectorEnv([lambda: make(**settings)] * 10)
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
    return Trained(lambda seen: best(net(seen["obs"])[0], seen["mask"]), settings)


def rllib(budget: Budget) -> Trained:
    """The defaults of its PPO, with its own masked network."""
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.rl_module import RLModuleSpec
    from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
    from ray.tune.registry import register_env

    settings = FLAT | {"mask_in_observation": "rllib"}
    register_env("uplink", lambda _: make(**settings))
    network = RLModuleSpec(module_class=ActionMaskingTorchRLModule)
    config = PPOConfig().environment("uplink").env_runners(num_env_runners=0).rl_module(rl_module_spec=network)
    algorithm = config.build_algo()
    with budget:
        while True:
            algorithm.train()
    net = algorithm.get_module()

    def act(seen: Any) -> Any:
        logits = net.forward_inference({"obs": {name: tensor(part) for name, part in seen.items()}})
        return logits["action_dist_inputs"].argmax(dim=-1)

    return Trained(act, settings)


def skrl(budget: Budget) -> Trained:
    """The defaults of its PPO on four environments, as in its examples; it knows no masks."""
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
    runner = Runner(wrap_env(make_batch(4, **FLAT)), cfg)
    with budget:
        runner.run("train")
    policy = runner.agent.models["policy"]
    return Trained(lambda seen: policy.compute({"observations": tensor(seen)}, role="policy")[0].argmax(-1), FLAT)


def agilerl(budget: Budget) -> Trained:
    """The defaults of its PPO on one native batch of eight, as on our page; it reads the mask of ``info``."""
    from agilerl.algorithms import PPO
    from agilerl.rollouts.on_policy import collect_rollouts

    settings = FLAT | {"mask_in_observation": True}
    envs = make_batch(8, **FLAT)
    spaces = envs.single_observation_space, envs.single_action_space
    agent = PPO(*spaces, num_envs=8, use_rollout_buffer=True, device="cpu")
    agent.set_training_mode(True)
    with budget:
        while True:
            collect_rollouts(agent, envs)
            agent.learn()
    net = agent.actor
    return Trained(
        lambda seen: best(net.head_net.wrapped(net.extract_features(tensor(seen["observation"]))), seen["action_mask"]),
        settings,
    )


LIBRARIES: dict[str, Callable[[Budget], Trained]] = {
    "cleanrl": cleanrl,
    "sbx": sbx,
    "torchrl": torchrl,
    "tianshou": tianshou,
    "rllib": rllib,
    "skrl": skrl,
    "agilerl": agilerl,
}


def page(library: str, minutes: float = 10.0, out: Path = Path("runs/ten_minutes.csv"), episodes: int = 40) -> None:
    """Train with one library and append its score to ``out``."""
    if library not in LIBRARIES:
        raise unknown("library", library, LIBRARIES)
    fixed = Episodes(episodes)
    trained: Any = LIBRARIES[library](Budget(minutes))
    score = fixed.of_model(trained, trained.settings)
    print(f"{library}: {score:.3f}")
    out.parent.mkdir(exist_ok=True)
    append(out, LINE, (library, f"{minutes:g}", f"{score:.4f}"))


if __name__ == "__main__":
    command(page)

"""TorchRL: the loop of its tutorial on PPO, shortened. It prints the mean regret of a decision after each update."""

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, check_env_specs
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import bufgym  # noqa: F401  (registers the environments)

env = GymEnv("bufgym/Uplink-v1", categorical_action_encoding=True, capacity=8, reward="regret")
check_env_specs(env)


def layers(outputs):
    return nn.Sequential(nn.Linear(27, 64), nn.Tanh(), nn.Linear(64, outputs))


scorer = TensorDictModule(layers(3), in_keys=["observation"], out_keys=["logits"])
keys = {"in_keys": ["logits"], "distribution_class": Categorical, "return_log_prob": True}
actor = ProbabilisticActor(scorer, spec=env.action_spec, **keys)
critic = ValueOperator(layers(1), in_keys=["observation"])
loss_of = ClipPPOLoss(actor, critic)
advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
optimizer = torch.optim.Adam(loss_of.parameters(), 3e-4)
for played in Collector(env, actor, frames_per_batch=1_000, total_frames=4_000):
    advantage(played)
    for _ in range(10):
        for part in torch.randperm(1_000).split(100):
            losses = loss_of(played[part])
            optimizer.zero_grad()
            sum(losses[f"loss_{name}"] for name in ("objective", "critic", "entropy")).backward()
            optimizer.step()
    print(f"regret a decision: {-played['next', 'reward'].mean().item():.4f}")

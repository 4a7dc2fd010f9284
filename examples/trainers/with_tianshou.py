"""Tianshou 2: its DQN."""

import gymnasium as gym
from tianshou.algorithm import DQN
from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import Net

import bufgym  # noqa: F401  (registers the environments)


def made():
    return gym.make("bufgym/Uplink-v1", capacity=8, reward="regret", info="mask")


space, actions = made().observation_space, made().action_space
net = Net(state_shape=space.shape, action_shape=actions.n, hidden_sizes=[64])
policy = DiscreteQLearningPolicy(model=net, action_space=actions, observation_space=space, eps_training=0.1)
algorithm = DQN(policy=policy, optim=AdamOptimizerFactory(lr=1e-3), gamma=0.99, target_update_freq=200)
collector = Collector(algorithm, DummyVectorEnv([made] * 4), VectorReplayBuffer(20_000, 4))
settings = {"max_epochs": 1, "epoch_num_steps": 2_000, "batch_size": 64, "collection_step_num_env_steps": 40}
algorithm.run_training(OffPolicyTrainerParams(training_collector=collector, test_in_training=False, **settings))

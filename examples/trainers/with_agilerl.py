"""AgileRL: ``collect_rollouts`` plays the native batch and reads ``info["action_mask"]`` by itself."""

import gymnasium as gym
from agilerl.algorithms import PPO
from agilerl.rollouts.on_policy import collect_rollouts

import bufgym  # noqa: F401  (registers the environments)

envs = gym.make_vec("bufgym/Uplink-v1", num_envs=8, capacity=8, reward="regret")
spaces = envs.single_observation_space, envs.single_action_space
agent = PPO(*spaces, num_envs=8, learn_step=512, batch_size=128, use_rollout_buffer=True, device="cpu")
agent.set_training_mode(True)
for _ in range(4):
    collect_rollouts(agent, envs)
    agent.learn()

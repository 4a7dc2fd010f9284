"""RLlib. Its workers are processes that have not imported bufgym, so the id names the module too."""

from ray.rllib.algorithms.ppo import PPOConfig

config = (
    PPOConfig()
    .environment("bufgym:bufgym/Uplink-v1", env_config={"capacity": 8, "reward": "regret"})
    .env_runners(num_env_runners=1)
    .training(train_batch_size_per_learner=2_000, minibatch_size=250, num_epochs=2)
)
algorithm = config.build_algo()
print(algorithm.train()["env_runners"]["episode_return_mean"])
algorithm.stop()

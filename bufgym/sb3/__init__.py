"""stable-baselines3 and sb3-contrib on bufgym: a vector environment, the slot network, trained models as policies.

    from stable_baselines3 import PPO
    from bufgym.sb3 import as_policy, make_vec_env

    model = PPO("MlpPolicy", make_vec_env("bufgym/Uplink-v1", 8, reward="regret"), n_steps=256).learn(200_000)
    policy = as_policy(model, "mine")  # runs wherever the built-in policies do

``export`` (or ``bufgym export``) writes its network to a file that bufgym runs without torch.
"""

from bufgym.utils.libraries import needs

with needs(("stable_baselines3", "sb3_contrib", "torch"), "train", "bufgym.sb3"):
    from bufgym.sb3.networks import SlotPolicy
    from bufgym.sb3.policies import as_policy
    from bufgym.sb3.vec_env import GymVecEnv, make_vec_env

__all__ = ["GymVecEnv", "SlotPolicy", "as_policy", "make_vec_env"]

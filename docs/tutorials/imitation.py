# %% [markdown]
# # 6. Imitation of the clairvoyant
#
# After an episode one can say what would have been best: the clairvoyant knows the whole link. Here a network learns
# from it and then plays without it. This needs the extras `train` and `plot`.
#
# ## Ask the expert
#
# For the state that each environment is in, the expert says what every action gives away for good, in QoI. An invalid
# action has no number.

# %%
import gymnasium as gym
import numpy as np

import bufgym
from bufgym.envs import expert

TRAIN = [f"lte-synthetic-{k}" for k in range(6)]
envs = gym.make_vec(
    "bufgym/Uplink-v1",
    64,
    capacity=8,
    duration_s=10.0,
    traces=TRAIN,
    autoreset_mode=gym.vector.AutoresetMode.SAME_STEP,
    actions="slots",
)
observation, info = envs.reset(seed=0)
judge = expert.clairvoyant(envs)
print(judge.regrets()[0].round(3))  # evict slot 0..7, reject, accept

# %% [markdown]
# ## A pupil
#
# `SlotPolicy` scores each message with the same small network. Elsewhere MaskablePPO trains it by reward; here it
# learns from examples.

# %%
import torch

from bufgym.sb3 import SlotPolicy

torch.manual_seed(0)
pupil = SlotPolicy(envs.single_observation_space, envs.single_action_space, lambda _: 3e-3)


def log_p(observation, mask):
    "The logarithm of the probability of each action."
    tensors = {name: torch.as_tensor(array) for name, array in observation.items()}
    return pupil.get_distribution(tensors, mask).distribution.logits


# %% [markdown]
# ## DAgger
#
# In the first round chance plays, later the pupil. So the expert labels the states that the pupil really comes to, not
# those that an expert would come to. The pupil learns probabilities: an action that gives away 0.02 more is e times
# less likely. (Ross, Gordon and Bagnell 2011.)

# %%
rng = np.random.default_rng(0)
rounds, seen, masks, given_away = 4, [], [], []
for k in range(rounds):
    for _ in range(300):  # the decisions of one episode
        mask = info["action_mask"].copy()
        seen.append({name: array.copy() for name, array in observation.items()})
        masks.append(mask)
        given_away.append(np.nan_to_num(judge.regrets()))
        with torch.no_grad():
            actions = log_p(observation, mask).argmax(1).numpy() if k else (rng.random(mask.shape) * mask).argmax(1)
        observation, _, _, _, info = envs.step(actions)
    X = {name: np.concatenate([one[name] for one in seen]) for name in seen[0]}
    M, regrets = np.concatenate(masks), torch.as_tensor(np.concatenate(given_away), dtype=torch.float32)
    target = (-regrets / 0.02).masked_fill(torch.as_tensor(M == 0), -1e9).softmax(1)
    pupil.optimizer.param_groups[0]["lr"] = 3e-3 * (1 - k / rounds)
    for batch in torch.randperm(len(M)).repeat(2).split(1024):
        loss = -(target[batch] * log_p({name: X[name][batch] for name in X}, M[batch])).sum(1).mean()
        pupil.optimizer.zero_grad()
        loss.backward()
        pupil.optimizer.step()
    print(f"round {k + 1}: {len(M):,} states, loss {loss.item():.3f}")

# %% [markdown]
# ## Does it help?
#
# `as_policy` makes the network a policy. The two links of the test were not in the training.

# %%
from bufgym.sb3 import as_policy

mine = as_policy(pupil, "imitation")
held_out = {"traces": ["lte-synthetic-6", "lte-synthetic-7"], "duration_s": 20.0}
compared = bufgym.compare([mine, "min-motion-gap", "afr", "drop-oldest"], "lte", **held_out)
print(compared)

# %% [markdown]
# The pupil is above AFR, and far below 1, the clairvoyant's score: [the guide](../guide/experts.md#experts) says why.
# `examples/imitation.py` trains longer.
#
# ## The picture

# %%
compared.plot().figure.savefig("imitation.png")

# %% [markdown]
# ![The regret of the pupil and of three rules](imitation.png)

"""Double DQN with action masks: stable-baselines3's DQN with another Q network, exploration and targets.

The observation shows which actions are valid (a slot holds a message; there is room), so no masks are stored. The Q
network itself gives invalid actions a value that no maximum picks, neither when it acts nor in a target.

Targets follow van Hasselt, Guez and Silver (2016): the online network chooses the next action, the target network
values it. Q is the sum of a state value and a score for each slot (after Wang et al., 2016), because one message makes
little difference beside all the reward still to come.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork
from torch import Tensor, nn
from torch.nn import functional

from agents import settings as options
from agents.decisions import SlotLearner
from bufgym.sb3.networks import SlotExtractor, SlotScorer

INVALID = -1e9
"""The value of an invalid action."""


def valid_actions(observation: Any) -> Tensor:
    """bool[n, L + 2]: evict a slot that holds a message, reject always, accept if there is room for one more."""
    held, room = (torch.as_tensor(observation[name]) for name in ("occupied", "occupancy"))
    return torch.cat([held > 0, room < 1], dim=1)


class SlotQ(nn.Module):
    """Q of all L + 2 actions from a ``SlotScorer``'s two outputs."""

    def __init__(self, features: SlotExtractor, width: int) -> None:
        super().__init__()
        self.scorer = SlotScorer(features, width, accept_bias=0.0)
        self.state = nn.Linear(width, 1)

    def forward(self, features: Tensor) -> Tensor:
        scores, latent = self.scorer(features)
        q: Tensor = scores + self.state(latent)
        return q


class MaskedQNetwork(QNetwork):
    """Q of every action, ``INVALID`` for invalid ones."""

    def forward(self, obs: Any) -> Tensor:
        q = super().forward(obs)
        return torch.where(valid_actions(obs), q, INVALID)


class MaskedDQNPolicy(DQNPolicy):
    """Two ``MaskedQNetwork``: slot by slot with a ``width``; plain layers (``net_arch``) with width 0."""

    def __init__(self, *args: Any, width: int = 32, **kwargs: Any) -> None:
        self.width = width
        kwargs.setdefault("features_extractor_class", SlotExtractor if width else CombinedExtractor)
        super().__init__(*args, **kwargs)

    def make_q_net(self) -> QNetwork:
        net = MaskedQNetwork(**self._update_features_extractor(self.net_args, features_extractor=None))
        if isinstance(net.features_extractor, SlotExtractor):
            net.q_net = SlotQ(net.features_extractor, self.width)  # type: ignore[assignment]
        return net.to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"width": self.width}


class MaskedDQN(DQN):
    """Double DQN that never tries an invalid action, as its network knows the masks.

    A resumed learner starts with an empty replay.
    """

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Explore in each environment separately: a valid action at random, all equally likely."""
        assert self._last_obs is not None
        actions, _ = self.policy.predict(self._last_obs, deterministic=True)
        valid = valid_actions(self._last_obs).numpy()
        explored = (np.random.random(valid.shape) * valid).argmax(axis=1)
        actions = np.where(np.random.random(n_envs) < self.exploration_rate, explored, actions)
        return actions, actions

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses = []
        for _ in range(gradient_steps):
            assert self.replay_buffer is not None
            sample = self.replay_buffer.sample(batch_size)
            with torch.no_grad():
                best = self.q_net(sample.next_observations).argmax(dim=1, keepdim=True)
                value = self.q_net_target(sample.next_observations).gather(1, best)
                target = sample.rewards + (1 - sample.dones) * self.gamma * value
            q = self.q_net(sample.observations).gather(1, sample.actions.long())
            loss = functional.smooth_l1_loss(q, target)
            self.policy.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(self.q_net.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()
            losses.append(loss.item())
        self._n_updates += gradient_steps
        self.logger.record("train/loss", np.mean(losses))


class SlotDQN(SlotLearner[options.DQN]):
    """Double DQN that chooses a slot."""

    algorithm = MaskedDQN

    def make(self, env: VecEnv) -> MaskedDQN:
        """Make an untrained Q network.

        It explores little: a message dropped at random is missing for the rest of the episode.
        """
        settings, width = self.settings, self.settings.width
        plain = {"width": 0, "net_arch": [2 * width, 2 * width]}
        return MaskedDQN(
            MaskedDQNPolicy,
            env,
            learning_rate=LinearSchedule(settings.learning_rate, 0.0, 1.0),
            buffer_size=max(settings.buffer_size, env.num_envs),
            learning_starts=settings.learning_starts,
            batch_size=settings.batch_size,
            gamma=settings.gamma,
            train_freq=(settings.train_freq, "step"),
            gradient_steps=settings.gradient_steps,
            target_update_interval=max(settings.target_update_interval, env.num_envs),
            exploration_initial_eps=0.1,
            exploration_final_eps=0.01,
            exploration_fraction=0.5,
            stats_window_size=env.num_envs,
            policy_kwargs={"width": width} if settings.network == "slots" else plain,
            device="cpu",
        )

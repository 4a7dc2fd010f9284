"""The slot network, which scores each slot with the same small network.

Scoring slots one by one builds knowledge of the problem in. A message's worth depends on its neighbours (the slot's own
features) and on the link (the context), not on the number of its slot. One set of weights serves every L.
"""

import hashlib
import inspect
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.maskable.policies import MaskableMultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from bufgym.utils.errors import BufgymError

ACCEPT_BIAS = 2.0  # Initial logit of accepting: exploration that drops messages where there is room learns little


OCCUPIED = "occupied"
"""The slot field that is 0 for an empty slot alone."""


def takes_masks(agent: Any) -> bool:
    """Whether the agent's ``predict`` takes ``action_masks``, as MaskablePPO's does."""
    return "action_masks" in inspect.signature(agent.predict).parameters


def array(parameter: Any) -> NDArray[np.float32]:
    """A copy of torch's numbers."""
    return np.array(parameter.detach().cpu().numpy(), np.float32)


def field_names(space: spaces.Dict) -> tuple[list[str], list[str]]:
    """Names of the slot fields (L + 1 >= 2 entries) and context fields (one entry) of a bufgym observation."""
    if not isinstance(space, spaces.Dict) or {"slots", "context"} & set(space.spaces):
        raise BufgymError('a slot network observes named fields: make its environment with observation="dict"')
    slots = [name for name, box in space.items() if (box.shape or (1,))[0] > 1]
    return slots, [name for name in space if name not in slots]


class SlotExtractor(BaseFeaturesExtractor):
    """[n, (L + 1) x (slot fields + context fields)]: each slot's features, followed by the context's."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        self.slot_fields, self.context_fields = field_names(observation_space)
        if not self.slot_fields:
            raise ValueError("scoring slots needs at least one slot field among the observed fields")
        self.slots = (observation_space[self.slot_fields[0]].shape or (0,))[0]
        self.per_slot = len(self.slot_fields) + len(self.context_fields)
        super().__init__(observation_space, self.slots * self.per_slot)

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        slots = torch.stack([observation[name] for name in self.slot_fields], dim=-1)
        if self.context_fields:
            context = torch.cat([observation[name] for name in self.context_fields], dim=-1)
            slots = torch.cat([slots, context[:, None, :].expand(-1, self.slots, -1)], dim=-1)
        return slots.flatten(1)


class SlotScorer(nn.Module):
    """Logits of all L + 2 actions, and the latent that the critic's value is read from.

    Args:
        features: the extractor, which knows the layout of the numbers.
        width: units of each hidden layer.
        masked: whether actions are masked. Empty slots are then never chosen, so they get the logit 0 unscored.
        accept_bias: initial logit of accepting.
    """

    def __init__(
        self, features: SlotExtractor, width: int, masked: bool = True, accept_bias: float = ACCEPT_BIAS
    ) -> None:
        super().__init__()
        slots, inputs = features.slots, features.per_slot
        self.shape = (slots, inputs)
        self.latent_dim_pi, self.latent_dim_vf = slots + 1, width
        self.occupied = next((k for k, name in enumerate(features.slot_fields) if name == OCCUPIED), None)
        self.masked = masked and self.occupied is not None
        self.score = _perceptron(inputs, width)
        """Slot -> logit of dropping it; the last slot is the newcomer, so its logit is for rejecting."""
        self.accept = _perceptron(inputs, width, accept_bias)
        """The newcomer's features -> logit of accepting it."""
        self.worth = nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.critic = nn.Sequential(nn.Linear(2 * width, width), nn.ReLU())

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def _slots(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Slots [n, slots, inputs] and whether each holds a message [n, slots]."""
        slots = features.reshape(-1, *self.shape)
        if self.occupied is None:
            return slots, torch.ones(slots.shape[:2], dtype=torch.bool)
        return slots, slots[..., self.occupied] > 0

    def forward_actor(self, features: Tensor) -> Tensor:
        slots, occupied = self._slots(features)
        if self.masked:
            drop = torch.zeros(occupied.shape).masked_scatter(occupied, self.score(slots[occupied]).squeeze(-1))
        else:
            drop = self.score(slots).squeeze(-1)
        return torch.cat([drop, self.accept(slots[:, -1])], dim=1)

    def forward_critic(self, features: Tensor) -> Tensor:
        """Latent from the mean over messages and from the newcomer, whose width is independent of L."""
        slots, occupied = self._slots(features)
        total = torch.zeros(len(slots), self.latent_dim_vf)
        total = total.index_add(0, occupied.nonzero()[:, 0], self.worth(slots[occupied]))
        mean = total / occupied.sum(dim=1, keepdim=True).clamp(min=1)
        latent: Tensor = self.critic(torch.cat([mean, self.worth(slots[:, -1])], dim=1))
        return latent


def _perceptron(inputs: int, width: int, bias: float = 0.0) -> nn.Sequential:
    """Make two hidden layers, and an output that begins close to ``bias``."""
    last = nn.Linear(width, 1)
    nn.init.uniform_(last.weight, -0.1 / width**0.5, 0.1 / width**0.5)
    nn.init.constant_(last.bias, bias)
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), last)


class SlotPolicy(MaskableMultiInputActorCriticPolicy):
    """Actor and critic from a ``SlotScorer``, for MaskablePPO or, with ``masked=False``, for PPO."""

    def __init__(self, *args: Any, width: int = 32, masked: bool = True, **kwargs: Any) -> None:
        self.width, self.masked = width, masked
        kwargs.pop("use_sde", None)  # PPO passes it to every policy, MaskablePPO to none; actions are discrete
        kwargs.setdefault("features_extractor_class", SlotExtractor)
        # Layers are initialised here as torch does; the library's orthogonal scheme would undo the accept bias.
        kwargs["ortho_init"] = False
        super().__init__(*args, **kwargs)

    def _build_mlp_extractor(self) -> None:
        features = self.features_extractor
        assert isinstance(features, SlotExtractor)
        self.mlp_extractor = SlotScorer(features, self.width, self.masked)  # type: ignore[assignment]

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        # The scorer's outputs are the logits already. The optimizer is made anew without the removed layer.
        self.action_net = nn.Identity()
        settings = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.optimizer = self.optimizer_class(self.parameters(), **settings)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"width": self.width, "masked": self.masked}


def fingerprint_of(agent: Any) -> str:
    """A hash of a model's numbers and of their names."""
    network = getattr(agent, "policy", agent)
    digest = hashlib.sha256()
    for name, tensor in network.state_dict().items():
        digest.update(f"{name}{list(tensor.shape)}".encode() + array(tensor).tobytes())
    return digest.hexdigest()

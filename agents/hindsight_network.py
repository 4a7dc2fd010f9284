"""The student of ``agents.hindsight``: a slot scorer in torch that begins as the rule ``gap-price``."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from bufgym.policies.learned import Network, Weights
from bufgym.policies.rule_fields import RULE_FIELDS, RULE_SLOT_FIELDS

CONTEXT, SLOT = [field.name for field in RULE_FIELDS], [field.name for field in RULE_SLOT_FIELDS]
PRIOR = 3.0
"""Score of what the rule chooses, before learning. A larger one hides what the rest is worth."""
IDLE = 30.0
"""Score of accepting at an idle socket, besides. Structural: far above what is learned."""
SCALE = 10.0
"""The network's output is multiplied by it, so that small steps of few weights reach large scores."""


class Scorer(nn.Module):
    """One network of a slot scorer, with two hidden layers; its output begins as weights ``prior`` of some fields."""

    skip: Tensor
    """[inputs]: the prior's weights, which do not change."""

    def __init__(self, width: int, prior: dict[str, float]) -> None:
        super().__init__()
        inputs = len(CONTEXT) + len(SLOT)
        self.first, self.second, self.out = nn.Linear(inputs, width), nn.Linear(width, width), nn.Linear(width, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        skip = torch.zeros(inputs)
        for name, weight in prior.items():
            skip[[*CONTEXT, *SLOT].index(name)] = weight
        self.register_buffer("skip", skip)

    def forward(self, slots: Tensor, context: Tensor) -> Tensor:
        """Scores [n, candidates] of ``slots`` [n, candidates, slot fields] in a ``context`` [n, context fields]."""
        c = len(CONTEXT)
        weight = self.first.weight
        # The context's part is the same for all candidates.
        common = nn.functional.linear(context, weight[:, :c], self.first.bias)
        h = torch.relu(nn.functional.linear(slots, weight[:, c:]) + common[:, None])
        h = torch.relu(self.second(h))
        prior = slots @ self.skip[c:] + (context @ self.skip[:c])[:, None]
        scores: Tensor = SCALE * self.out(h)[..., 0] + prior
        return scores

    def network(self) -> Network:
        """The same as numbers."""
        numbers = {name: tensor.detach().numpy() for name, tensor in self.state_dict().items()}
        layers = tuple((numbers[f"{k}.weight"].T.copy(), numbers[f"{k}.bias"].copy()) for k in ("first", "second"))
        scale = np.float32(SCALE)
        return Network(numbers["skip"].copy(), scale * numbers["out.bias"], layers, scale * numbers["out.weight"][0])


class Student(nn.Module):
    """Scores of all L + 2 actions: to drop each slot, to reject, to accept."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.drop = Scorer(width, {"rule_drops": PRIOR})
        self.accept = Scorer(width, {"rule_accepts": PRIOR, "rule_idle": IDLE})

    def forward(self, slots: Tensor, context: Tensor) -> Tensor:
        return torch.cat([self.drop(slots, context), self.accept(slots[:, -1:], context)], dim=1)

    def weights(self) -> Weights:
        """The weights as in a file."""
        return Weights((*CONTEXT, *SLOT), self.drop.network(), self.accept.network())


def mean_regret(scores: Tensor, regret: Tensor) -> Tensor:
    """The mean of sum_a p(a) regret(a), p being the softmax of the scores of valid actions."""
    valid = torch.isfinite(regret)
    chances = torch.softmax(scores.masked_fill(~valid, -math.inf), dim=1)
    return (chances * regret.masked_fill(~valid, 0)).sum(dim=1).mean()

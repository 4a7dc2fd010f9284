"""The student of ``agents.hindsight``: one perceptron on what ordered candidates show, in torch."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from bufgym.policies.ruled_network import RuledWeights, fields_seen, seen

START = 2.0
"""Bias of action 0 before learning, "accept where there is room, else drop the cheapest"; all other outputs are 0."""
NEVER = -1e9
"""Output in place of that of an action which is not offered."""
LAYERS = 0, 2, 4


class Student(nn.Sequential):
    """Outputs [n, actions] of what n environments with k candidates show at arrivals; two hidden layers of ``width``.

    One unit of each layer begins as a switch: the rule decides while the link is steady.
    """

    def __init__(self, candidates: int, width: int) -> None:
        first, second = nn.Linear(int(seen(candidates)), width), nn.Linear(width, width)
        out = nn.Linear(width, candidates + 3)
        super().__init__(first, nn.ReLU(), second, nn.ReLU(), out)  # tanh would take as long as all the rest
        self.candidates = candidates
        nn.init.zeros_(out.weight)
        nn.init.zeros_(out.bias)
        with torch.no_grad():
            out.bias[0] = START
            for layer in first, second:
                layer.weight[0], layer.bias[0] = 0.0, 0.0
            first.bias[0] = -1.0
            first.weight[0, fields_seen(candidates).index("rule_plain")] = 2.0
            second.weight[0, 0] = 1.0
            out.weight[-1, 0], out.weight[0, 0] = 2 * START, -START

    def weights(self) -> RuledWeights:
        """The weights as in a file."""
        numbers = {name: tensor.detach().numpy() for name, tensor in self.named_parameters()}
        layers = tuple((numbers[f"{k}.weight"].T.copy(), numbers[f"{k}.bias"].copy()) for k in LAYERS)
        return RuledWeights(self.candidates, at_arrivals=True, masks=True, activation="relu", layers=layers)


def expected(outputs: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """Each state's sum_a p(a) cost(a), p being the softmax of the outputs, and the entropy of p.

    ``cost`` [n, actions] is infinite for actions that are not offered.
    """
    offered = torch.isfinite(cost)
    log_p = torch.log_softmax(outputs.masked_fill(~offered, NEVER), dim=1)
    p = log_p.exp()
    return (p * cost.masked_fill(~offered, 0)).sum(dim=1), -(p * log_p).sum(dim=1)


def ranked(outputs: Tensor, cost: Tensor) -> Tensor:
    """Each state's sum over pairs of offered actions, a dearer than b, of

        (cost(a) - cost(b)) log(1 + exp(output(a) - output(b))).

    For a pair it is least where output(b) - output(a) is the logarithm of what b saves over what b loses: above 0 if b
    costs less on average. Its gradient does not vanish while an order is wrong, as that of ``expected`` does.
    """
    offered = torch.isfinite(cost)
    pairs = offered[:, :, None] & offered[:, None, :]
    known = cost.masked_fill(~offered, 0)
    more = (known[:, :, None] - known[:, None, :]).clamp(min=0) * pairs
    return (more * functional.softplus(outputs[:, :, None] - outputs[:, None, :])).sum(dim=(1, 2))

"""Models that choose among ordered candidates: their networks as weights, and their decisions in torch."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.dqn.policies import DQNPolicy
from torch import nn

from bufgym.envs.observation import ObservationForm, fields_of
from bufgym.envs.own import write_in_python
from bufgym.model.buffer import ACCEPT, Buffer, has_space
from bufgym.model.observe import (
    BUILT_IN,
    CANDIDATE_FIELDS,
    QUEUE_FIELDS,
    decision_of_candidate,
    find_candidates,
    is_offered,
    observe_candidates,
    own_field,
    write_chosen,
)
from bufgym.policies.candidate_network import CandidateWeights, inputs
from bufgym.policies.weights import MAX_WIDTH
from bufgym.sb3.networks import array, fingerprint_of, takes_masks
from bufgym.utils.errors import BufgymError

_FIRST = CANDIDATE_FIELDS[0].name
_ACTIVATIONS = {nn.Tanh: "tanh", nn.ReLU: "relu"}


def candidates_of(agent: Any) -> int | None:
    """k, if the model observes k candidates and the head, otherwise None."""
    space, actions = agent.observation_space, int(getattr(agent.action_space, "n", 0))
    for k in (actions - 1, actions - 2):
        if k >= 1 and _observes(space, k):
            return k
    return None


def _observes(space: Any, candidates: int) -> bool:
    """Whether the space is one of so many candidates and the head."""
    fields = fields_of(space)
    if fields is not None:
        return fields.get(_FIRST) == candidates + 1
    return bool(space == _form("flat", candidates).space)


def _form(form: str, candidates: int, capacity: int = 1, names: list[str] | None = None) -> ObservationForm:
    return ObservationForm(form, CANDIDATE_FIELDS, QUEUE_FIELDS, capacity, names, candidates=candidates)


def perceptron(policy: Any, candidates: int) -> CandidateWeights | None:
    """The weights of an ``MlpPolicy`` of PPO, A2C, MaskablePPO or DQN; None if a file has no place for its network."""
    if type(policy) is DQNPolicy:
        extractor, layers = policy.q_net.features_extractor, [*policy.q_net.q_net]
    elif type(policy) in (ActorCriticPolicy, MaskableActorCriticPolicy) and type(policy.mlp_extractor) is MlpExtractor:
        extractor, layers = policy.pi_features_extractor, [*policy.mlp_extractor.policy_net, policy.action_net]
    else:
        return None
    *hidden, last = layers
    linear, kinds = [*hidden[::2], last], {type(layer) for layer in hidden[1::2]} or {nn.ReLU}
    known = type(extractor) is FlattenExtractor and len(kinds) == 1 and kinds <= {*_ACTIVATIONS}
    if not known or not all(type(layer) is nn.Linear and layer.bias is not None for layer in linear):
        return None
    widths = [layer.out_features for layer in linear[:-1]]
    if len(widths) > CandidateWeights.LAYERS or max(widths, default=0) > MAX_WIDTH:
        return None
    if linear[0].in_features != inputs(candidates):  # it observes fields by name, too
        return None
    numbers = tuple((array(layer.weight).T.copy(), array(layer.bias)) for layer in linear)
    at_arrivals = int(policy.action_space.n) == candidates + 2
    return CandidateWeights(candidates, at_arrivals, takes_masks(policy), _ACTIVATIONS[kinds.pop()], numbers)


class CandidateDecisions:
    """Decisions of a model among candidates, one at a time, in torch."""

    def __init__(self, name: str, agent: Any, candidates: int, masked: bool) -> None:
        self.name, self.agent, self.candidates, self.masked = name, agent, candidates, masked
        self.fingerprint = fingerprint_of(agent)
        self.at_arrivals = int(agent.action_space.n) == candidates + 2
        space = agent.observation_space
        form = "flat" if not isinstance(space, spaces.Dict) else "slots" if "slots" in set(space) else "dict"
        fields = fields_of(space)
        names = None if fields is None else list(fields)
        known = {field.name for field in (*CANDIDATE_FIELDS, *QUEUE_FIELDS)}
        self.capacity: int | None = None
        """L that the model was trained for; None if it serves every L."""
        for key, numbers in (fields or {}).items():
            field = BUILT_IN.get(key) or own_field(key)
            if key not in known and field is None:
                raise BufgymError(f"model {name}: observes {key!r}, which is no field (bufgym list observations)")
            if field is not None and field.per == "slot":
                self.capacity = numbers - 1
        self.form = _form(form, candidates, self.capacity or 1, names)
        if self.form.space != space:
            rule = f"must be the {inputs(candidates)} of {candidates} candidates and the head, and fields by name"
            raise BufgymError(f"model {name}: observes {spaces.flatdim(space)} numbers: {rule}")

    def on_arrival(self, buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
        """A slot to evict, REJECT or ACCEPT."""
        if self.capacity not in (None, buffer.capacity):
            raise BufgymError(
                f"policy {self.name}: trained for L = {self.capacity}, not for L = {buffer.capacity}, as it observes a "
                "field of each slot; a model that observes candidates and the queue alone serves every L"
            )
        room, places = has_space(buffer, arrival), self.candidates + 1
        if room and not self.at_arrivals:
            return ACCEPT
        order, cost, row = np.zeros(places, np.int64), np.zeros(places), np.zeros(self.form.numbers, np.float32)
        find_candidates(buffer, arrival, order, cost)
        observe_candidates(buffer, arrival, order, cost, row[: self.form.table_numbers])
        if self.form.named is not None:
            write_chosen(buffer, arrival, self.form.named, row)
        for place in self.form.own_places:
            write_in_python(place, buffer, arrival, True, row)
        offered = [is_offered(order, self.at_arrivals, room, a) for a in range(places + self.at_arrivals)]
        masks = {"action_masks": np.array(offered)} if self.masked else {}
        action, _ = self.agent.predict(self.form.of(row), deterministic=True, **masks)
        return int(decision_of_candidate(order, len(buffer.slots), self.at_arrivals, room, int(action)))

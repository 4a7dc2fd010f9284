"""``as_policy``: any trained model of stable-baselines3 or sb3-contrib as a policy for runs and benchmarks."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from bufgym.envs.observation import ObservationForm, fields_of
from bufgym.envs.own import write_in_python
from bufgym.model import observe
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, Buffer, is_first
from bufgym.policies import Policy, candidate_network
from bufgym.policies.schedulers import fits, makes_room
from bufgym.policies.weights import StrPath
from bufgym.sb3.candidates import CandidateDecisions, candidates_of, perceptron
from bufgym.sb3.export import read_policy, refuse_normalized, weights_of
from bufgym.sb3.networks import SlotScorer, fingerprint_of, takes_masks
from bufgym.utils.errors import BufgymError


def as_policy(model: BaseAlgorithm | BasePolicy | StrPath, name: str = "") -> Policy:
    """Make a bufgym policy of a trained model; it takes the model's most likely or most valued action.

    Two kinds of networks run compiled and serve every L: "MlpPolicy" of PPO, A2C, MaskablePPO and DQN that observes
    candidates, "flat", and a network that scores slots with masks (``SlotPolicy`` under MaskablePPO). Any other network
    runs in torch, one decision at a time. It serves every L if it observes candidates, and otherwise the L it was
    trained for. Algorithms that take action masks get them. For others, an invalid action does the same as in
    the environment. An observation "slots" must be of every field; the space of a "dict" or "flat" one has the names
    of its fields, which a wrapper that makes a space of its own loses.

        policy = as_policy("model.zip", "mine")
        bufgym.benchmark.run.run([policy, policies.get("afr")], scenario, capacities=[8], seeds=10)

    Args:
        model: the model, its ``policy``, or the path of a saved one. A zip holds pickles, and reading it can run any
            code: read your own alone.
        name: the policy's name; by default that of the file or class.

    Raises:
        BufgymError: no such file, or a model that was not trained on a bufgym environment, or through ``VecNormalize``.
    """
    agent: Any = model if isinstance(model, BaseAlgorithm | BasePolicy) else read_policy(model)
    if not name:
        name = type(model).__name__.lower() if agent is model else Path(str(model)).stem
    network = agent.policy if isinstance(agent, BaseAlgorithm) else agent
    if getattr(network, "lstm_actor", None) is not None:
        raise BufgymError(f"model {name}: has a recurrent network, whose state a policy cannot keep")
    refuse_normalized(agent)
    about = f"A trained {type(agent).__name__}."
    masked = takes_masks(agent) and getattr(network, "masked", True)
    candidates = candidates_of(agent)
    if candidates is not None:
        weights = perceptron(network, candidates)
        if weights is not None:
            return weights.policy(name, about)
        return Policy(
            name, CandidateDecisions(name, agent, candidates, masked).on_arrival, about=about, reads_rate=True
        )
    decisions = _Decisions(name, agent, masked)
    if masked and isinstance(getattr(network, "mlp_extractor", None), SlotScorer) and not decisions.for_topics:
        return weights_of(network).policy(name, about)
    if not decisions.for_topics:
        return Policy(name, decisions.on_arrival, about=about, reads_rate=True)
    return Policy(name, decisions.on_arrival, on_send=decisions.on_send, about=about, reads_rate=True, for_topics=True)


class _Decisions:
    """Decisions of a model from a robot's view, one at a time."""

    def __init__(self, name: str, agent: Any, masked: bool) -> None:
        self.name, self.agent, self.masked = name, agent, masked
        self.fingerprint = fingerprint_of(agent)
        space, actions = agent.observation_space, agent.action_space
        self.capacity = int(getattr(actions, "n", 0)) - 2
        if self.capacity < 1:
            rule = "must be Discrete(L + 2), or that of candidates"
            raise BufgymError(f"model {name}: action space {actions}: {rule}")
        form = "dict" if isinstance(space, spaces.Dict) else "flat"
        fields, numbers = fields_of(space), spaces.flatdim(space)
        names = None if fields is None else list(fields)
        all_fields = (
            observe.SLOT_FIELDS + observe.TOPIC_SLOT_FIELDS,
            observe.CONTEXT_FIELDS + observe.TOPIC_CONTEXT_FIELDS,
        )
        if names is None:
            self.for_topics = numbers == ObservationForm(form, *all_fields, self.capacity).numbers
        else:
            self.for_topics = any(field.name in names for field in observe.TOPIC_FIELDS)
        per_slot, context = all_fields if self.for_topics else (observe.SLOT_FIELDS, observe.CONTEXT_FIELDS)
        known = [field.name for field in per_slot + context]
        for field in names or ():
            if field not in (*known, *observe.BUILT_IN) and observe.own_field(field) is None:
                raise BufgymError(f"model {name}: observes {field!r}, which is no field (bufgym list observations)")
        only_chosen = names is not None and not self.for_topics
        self.form = ObservationForm(form, per_slot, context, self.capacity, names, only_chosen=only_chosen)
        if self.for_topics and (self.form.named is not None or self.form.own_places):
            raise BufgymError(f"model {name}: observes fields of one's own; with several topics no policy can")
        expected = spaces.flatdim(self.form.space)
        if numbers != expected:
            rule = f"must be the {expected} of {', '.join(names or known)} for L = {self.capacity}"
            if form == "flat":
                known_sizes = " or ".join(str(candidate_network.inputs(k)) for k in (self.capacity, self.capacity + 1))
                rule += f"; of candidates {known_sizes}, and further fields where the space has their names"
            raise BufgymError(f"model {name}: observes {numbers} numbers: {rule}")

    def on_arrival(self, buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
        """A slot to evict, REJECT or ACCEPT."""
        room = fits(buffer, arrival)
        evictable = [makes_room(buffer, arrival, k) for k in range(len(buffer.slots))]
        no_drop = self.for_topics and buffer.topics[arrival.topic].no_drop == 1
        may_reject = not no_drop or not (room or any(evictable))
        action = self._action(buffer, arrival, memory, True, [*evictable, may_reject, room])
        return action if action < self.capacity else REJECT if action == self.capacity else ACCEPT

    def on_send(self, buffer: Buffer, memory: NDArray[np.float64]) -> int:
        """The slot to send, or HOLD."""
        sendable = [is_first(buffer, k) for k in range(len(buffer.slots))]
        action = self._action(buffer, buffer.slots[0], memory, False, [*sendable, True, False])
        return action if action < self.capacity else HOLD

    def _action(
        self, buffer: Buffer, arrival: Any, memory: NDArray[np.float64], arriving: bool, valid: Sequence[bool]
    ) -> int:
        """The model's action; ``valid`` has an entry for each queued slot's action, then for L and L + 1."""
        L = buffer.capacity
        if L != self.capacity:
            raise BufgymError(
                f"policy {self.name}: trained for L = {self.capacity}, not for L = {L}; only a network that scores "
                "slots with masks (MaskablePPO with bufgym.sb3.SlotPolicy) or chooses among candidates serves every L"
            )
        row = np.zeros(self.form.numbers, np.float32)
        if self.form.named is not None:
            observe.write_chosen(buffer, arrival, self.form.named, row)
        else:
            slots, context = self.form.split(row)
            if self.for_topics:
                observe.observe_topic_slots(buffer, arrival, arriving, slots)
                observe.observe_topic_context(buffer, arrival, arriving, context)
            else:
                observe.observe(buffer, arrival, slots, context)
        for place in self.form.own_places:
            write_in_python(place, buffer, arrival, arriving, row)
        mask = np.zeros(L + 2, np.bool_)
        mask[: len(buffer.slots)], mask[L:] = valid[:-2], valid[-2:]
        masks = {"action_masks": mask} if self.masked else {}
        action, _ = self.agent.predict(self.form.of(row), deterministic=True, **masks)
        return int(action)

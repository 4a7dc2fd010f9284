"""A trained agent as a file of weights that bufgym runs without torch (``bufgym.policies.weights``)."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from torch import nn

from bufgym.oracle.interruption import EveryLength
from bufgym.policies import Policy
from bufgym.policies import weights as files
from bufgym.policies.candidate_network import CandidateWeights
from bufgym.policies.learned import Network, Weights
from bufgym.policies.weights import MAX_WIDTH, StrPath
from bufgym.sb3.candidates import candidates_of, perceptron
from bufgym.sb3.networks import SlotExtractor, SlotScorer, array
from bufgym.scenario import suites
from bufgym.utils.errors import BufgymError

CHECKED = (4, 8, 16, 32)  # Values of L for the regrets noted in the file


def export(model: StrPath, out: StrPath, *, name: str, about: str = "") -> Path:
    """Write the agent in ``model`` to ``out``, with its training notes from the run's folder.

    Args:
        model: a run's ``model.safetensors``, which gets its name and its scores; or the zip of a model of
            stable-baselines3 that chooses among candidates or has the ``SlotPolicy``. A zip holds pickles, and reading
            it can run any code: export your own alone.
        out: the file to write, .safetensors.
        name: the policy's name.
        about: a sentence on what it was trained for.

    Raises:
        BufgymError: ``model`` is no such agent, or ``out`` cannot be written.
    """
    path = Path(model)
    weights = files.read(path)[0] if path.suffix == ".safetensors" else weights_of(read_policy(path))
    notes = {"name": name, "about": about, **run_notes(path)}
    policy = weights.policy(name)
    return files.save(out, weights, notes if policy.for_topics else {**notes, "regret": regrets(policy)})


def read_policy(path: StrPath) -> BasePolicy:
    """Read the policy network from a saved model's zip, for any algorithm.

    Raises:
        BufgymError: no such file, or no model of stable-baselines3.
    """
    if not Path(path).is_file():
        raise BufgymError(f"{path}: no such file")
    try:
        saved, parameters, _ = load_from_zip_file(Path(path), device="cpu")
        assert saved is not None
        arguments = dict(saved["policy_kwargs"])
        policy: BasePolicy = saved["policy_class"](
            saved["observation_space"], saved["action_space"], lambda _: 0.0, **arguments
        )
        policy.load_state_dict(dict(parameters["policy"]))
    except Exception as error:  # a zip of pickles can raise any kind
        raise BufgymError(f"{path}: no model of stable-baselines3: {type(error).__name__}: {error}") from None
    policy.set_training_mode(False)
    return policy


def weights_of(model: Any) -> Weights | CandidateWeights:
    """Weights of a model's actor or Q-network; a critic only served training.

    Args:
        model: PPO, A2C, MaskablePPO or DQN with "MlpPolicy" on ``actions="candidates"``, or MaskablePPO with
            ``SlotPolicy``; or the ``policy`` of one.

    Raises:
        BufgymError: a file has no place for its network.
    """
    refuse_normalized(model)
    policy = getattr(model, "policy", model)
    candidates = candidates_of(policy)
    if candidates is not None:
        found = perceptron(policy, candidates)
        if found is None:
            raise BufgymError(
                f'only networks of PPO, A2C, MaskablePPO or DQN with "MlpPolicy" and at most {CandidateWeights.LAYERS} '
                f"hidden layers of {MAX_WIDTH} units, tanh or relu, that observe no fields by name, can be exported "
                f"among candidates, and {type(policy).__name__} is another; as_policy runs it in torch"
            )
        return found
    features, scorer = (getattr(policy, part, None) for part in ("features_extractor", "mlp_extractor"))
    if not isinstance(features, SlotExtractor) or not isinstance(scorer, SlotScorer):
        raise BufgymError(
            "only an agent that chooses among candidates, observed flat, or scores slots can be exported "
            "(bufgym.sb3.SlotPolicy)"
        )
    fields = (*features.slot_fields, *features.context_fields)
    return Weights(fields, _network(scorer.score), _network(scorer.accept))


def _network(perceptron: nn.Sequential) -> Network:
    """ReLU layers, one output and no direct weights of the inputs; torch keeps weights as [outputs, inputs]."""
    *hidden, last = [layer for layer in perceptron if isinstance(layer, nn.Linear)]
    return Network(
        np.zeros(hidden[0].in_features, np.float32),
        array(last.bias),
        tuple((np.ascontiguousarray(array(layer.weight).T), array(layer.bias)) for layer in hidden),
        array(last.weight)[0],
    )


def refuse_normalized(model: Any) -> None:
    """Raise a BufgymError if the model observes through ``VecNormalize``."""
    found = getattr(model, "get_vec_normalize_env", lambda: None)()
    if found is not None and found.norm_obs:
        raise BufgymError(
            "a model that observes through VecNormalize needs its running means, which a policy does not have: train "
            "with norm_obs=False, as all fields are scaled already"
        )


def regrets(policy: Policy) -> dict[str, float]:
    """The policy's exact regret in interruption-v1's test split, for each V and L of ``CHECKED``, as a test value."""
    rounded = {}
    for label, setting in suites.get("interruption-v1").settings("test").items():
        for L, regret in zip(CHECKED, EveryLength(setting.scenario, CHECKED).regrets(policy), strict=True):
            rounded[f"{label}, L = {L}"] = round(regret, 9)
    return rounded


def run_notes(model: Path) -> dict[str, Any]:
    """Notes that train.py left beside the model (``notes.json``): command, seeds and scores; {} without them."""
    path = model.with_name("notes.json")
    if not path.is_file():
        return {}
    try:
        notes: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BufgymError(f"{path}: cannot be read: {error}") from None
    return notes

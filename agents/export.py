"""A trained agent as a file that bufgym decides by without torch: ``bufgym.policies.weights``.

The model is an evolved agent's file of weights, which gets its name and its scores, or stable-baselines3's zip of a
MaskablePPO with ``network.SlotPolicy``. A zip holds pickles, and reading it can run any code: export models of your own
alone. ``python -m agents.export MODEL OUT --name N`` is ``bufgym export``.
"""

from __future__ import annotations

import json
import math
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO
from torch import nn

from agents.grounds import Lengths
from agents.worlds import Cell
from bufgym.benchmark.topics import run_parts, suite_parts
from bufgym.errors import BufgymError
from bufgym.policies import Policy, learned, learned_topics
from bufgym.policies import weights as files
from bufgym.policies.learned import Network, Weights
from bufgym.policies.learned_topics import TopicWeights
from bufgym.policies.weights import StrPath
from bufgym.sb3.networks import SlotFeatures, SlotScorer
from bufgym.scenario import suites


def export(model: StrPath, out: StrPath, *, name: str, about: str = "") -> Path:
    """Write the agent in ``model`` to ``out``, with what its run's folder tells of its training.

    Raises:
        BufgymError: ``model`` is no agent that scores slots, or ``out`` cannot be written.
    """
    path = Path(model)
    weights = files.read_any(path)[0] if path.suffix == ".safetensors" else weights_of(_loaded(path))
    notes = {"name": name, "about": about, **training(path)}
    if isinstance(weights, TopicWeights):
        return files.save(out, weights, {**notes, "weighted_qoi": weighted(learned_topics.policy(name, weights))})
    return files.save(out, weights, {**notes, "regret": regrets(learned.policy(name, weights))})


CHECKED = (4, 8, 16, 32)
"""L of the regrets that are noted."""


def regrets(policy: Policy) -> dict[str, float]:
    """Its regret, for a test to find again: in each V of interruption-v1's test split, exact; L = 4, 8, 16, 32."""
    settings = suites.get("interruption-v1").settings("test")
    return {
        f"{label}, L = {L}": round(Lengths(Cell(label, setting.scenario, L)).regret(policy), 9)
        for label, setting in settings.items()
        for L in CHECKED
    }


def weighted(policy: Policy) -> dict[str, float]:
    """A scheduler's weighted QoI, for a test to find again: on the first test episode of each setting of topics-v1."""
    found = suites.get("topics-v1")
    rows = run_parts(
        [policy], [part._replace(seeds=part.seeds[:1]) for part in suite_parts(found, "test")], found.capacities
    )
    first: dict[str, float] = {}
    for row in rows:
        first.setdefault(row["scenario"], round(row["weighted_qoi"], 6))
    return first


def _loaded(path: Path) -> MaskablePPO:
    if not path.is_file():
        raise BufgymError(f"{path}: no such file")
    try:
        return MaskablePPO.load(path, device="cpu")
    except Exception as error:  # of whatever kind a zip of pickles raises
        raise BufgymError(f"{path}: no model of MaskablePPO: {type(error).__name__}: {error}") from None


def weights_of(model: MaskablePPO) -> Weights:
    """The actor's two networks; the critic was for training alone."""
    features, scorer = model.policy.features_extractor, model.policy.mlp_extractor
    if not isinstance(features, SlotFeatures) or not isinstance(scorer, SlotScorer):
        raise BufgymError("only an agent that scores slots can be exported (train.py --network slots)")
    fields = (*features.slot_fields, *features.context_fields)
    return Weights(fields, _network(scorer.score), _network(scorer.accept))


def _network(perceptron: nn.Sequential) -> Network:
    """ReLU layers and one output; torch keeps weights as [outputs, inputs]."""
    *hidden, last = [layer for layer in perceptron if isinstance(layer, nn.Linear)]
    return Network(
        np.zeros((hidden[0] if hidden else last).in_features, np.float32),
        _array(last.bias),
        tuple((np.ascontiguousarray(_array(layer.weight).T), _array(layer.bias)) for layer in hidden),
        _array(last.weight)[0],
    )


def _array(parameter: Any) -> NDArray[np.float32]:
    return np.array(parameter.detach().cpu().numpy(), np.float32)


def training(model: Path) -> dict[str, Any]:
    """What the run's folder says: the command, the seeds, and the scores if it was evaluated; empty elsewhere."""
    for folder in (model.parent, model.parent.parent):  # the run's best model, or one seed's
        if (folder / "settings.json").is_file():
            break
    else:
        return {}
    settings = _json(folder / "settings.json")
    notes: dict[str, Any] = {"training": command(settings), "seeds": _seeds(settings, model)}
    if folder == model.parent and (by_suite := _scores(folder, settings)):
        notes["scores"] = by_suite
    results = folder / "results.json"
    if results.is_file() and folder == model.parent:
        found = _json(results)
        rows = {row["policy"]: row["qoi"] for row in found["scores"]}
        agent = found["agent"]
        notes["seeds"] = [int(agent.removeprefix("agent (seed ").removesuffix(")"))]
        notes["scores"] = {"qoi": rows[agent], "drop-oldest": rows["drop-oldest"], "held_out": found["held_out"]}
    return notes


def _scores(folder: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Of a run on several suites: each one's score with its interval over episodes and all training seeds."""
    found = {}
    for suite in settings.get("suite", "").split(","):
        path = folder / suite / "results.json"
        if not suite or not path.is_file():
            continue
        results = _json(path)
        agent = next(s for s in results["standings"] if s["policy"] == f"agent ({settings['algo']})")
        value, low, high = agent["score"]
        if math.isfinite(value):
            found[suite] = {"score": value, "interval": [low, high]}
    return found


def _json(path: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BufgymError(f"{path}: cannot be read: {error}") from None
    return found


def _seeds(settings: dict[str, Any], model: Path) -> list[int]:
    """That of the model's own folder, or all of the run's."""
    own = model.parent.name.removeprefix("seed-")
    return [int(own)] if own.isdigit() else [settings["seed"] + i for i in range(settings["seeds"])]


def command(settings: dict[str, Any]) -> str:
    """The command that trains it again: settings that are not train.py's own."""
    from train import Arguments

    default = vars(Arguments())
    words = [
        f"--{key.replace('_', '-')} {shlex.quote(str(value))}"
        for key, value in settings.items()
        if key not in ("name", "resume") and value != default.get(key)
    ]
    return " ".join(["python train.py", *words])


if __name__ == "__main__":
    from bufgym.cli import main

    raise SystemExit(main(["export", *sys.argv[1:]]))

"""Random weights of learned policies and their files, for the tests of all kinds."""

import itertools
import json
import math

import numpy as np
import pytest
from safetensors.numpy import load as tensors_of
from safetensors.numpy import save as safetensors

from bufgym import policies
from bufgym.policies import weights
from bufgym.policies.candidate_network import CandidateWeights, inputs
from bufgym.policies.learned import Network, Weights
from bufgym.policies.ruled_network import RuledWeights, seen
from bufgym.utils.errors import BufgymError


def network(rng, inputs, *widths):
    """A network whose every number is random, with hidden layers of these widths."""

    def some(*shape):
        return rng.normal(size=shape).astype(np.float32)

    layers = tuple((some(a, b), some(b)) for a, b in itertools.pairwise([inputs, *widths]))
    return Network(some(inputs), some(1), layers, some(widths[-1] if widths else 0))


def score(net, f):
    """The formula in the text of ``bufgym.policies.learned``, number by number."""
    h = f
    for weight, bias in net.layers:
        sums = [math.fsum(each * float(w) for each, w in zip(h, weight[:, o], strict=True)) for o in range(len(bias))]
        h = [max(0.0, total + float(b)) for total, b in zip(sums, bias, strict=True)]
    out = math.fsum(float(w) * each for w, each in zip(net.out, h, strict=True)) if net.layers else 0.0
    return out + math.fsum(float(s) * each for s, each in zip(net.skip, f, strict=True)) + float(net.bias[0])


def random_weights(fields, *widths, seed=0):
    """Of a slot scorer."""
    rng = np.random.default_rng(seed)
    return Weights(tuple(fields), *(network(rng, len(fields), *widths) for _ in Weights.NETWORKS))


def random_layers(sizes, seed, accept):
    """Layers of these sizes; the first output is ``accept`` higher."""
    rng = np.random.default_rng(seed)
    pairs = itertools.pairwise(sizes)
    layers = [(2 * rng.normal(size=pair) / pair[0] ** 0.5, rng.normal(size=pair[1])) for pair in pairs]
    layers[-1][1][0] += accept
    return tuple((weight.astype(np.float32), bias.astype(np.float32)) for weight, bias in layers)


def random_choices(k, at_arrivals, *widths, masks=False, activation="tanh", seed=0, accept=0.0):
    """Of a network among k candidates and the head, inclined to its first action by ``accept``."""
    return CandidateWeights(
        k, at_arrivals, masks, activation, random_layers([inputs(k), *widths, k + 1 + at_arrivals], seed, accept)
    )


def random_ruled(k, *widths, activation="tanh", seed=0, accept=0.0):
    """Of a network among k candidates, the head and what the rule does, inclined to its first action by ``accept``."""
    layers = random_layers([seen(k), *widths, k + 3], seed, accept)
    return RuledWeights(k, True, True, activation, layers)


KINDS = QUEUE, CHOICES = Weights, CandidateWeights
FIELDS = ("time_merged", "service_ratio")
ABOUT = {"name": "small", "about": "Drops what is in its way.", "seeds": [0, 1], "scores": {"regret": 0.25}}


def made(*widths, kind=QUEUE, fields=FIELDS, seed=0):
    """Weights of any kind; the network among candidates is asked at arrivals, and has no masks."""
    if kind is CHOICES:
        return random_choices(2, True, *widths, seed=seed)
    return random_weights(fields, *widths, seed=seed)


def parts_of(path):
    """The tensors and the metadata of a valid file, to be changed and written again by ``put``."""
    return tensors_of(path.read_bytes()), weights.read(path)[1]


def put(path, tensors, metadata):
    """Any tensors with any metadata."""
    text = metadata if isinstance(metadata, str) else json.dumps(metadata)
    path.write_bytes(safetensors(tensors, metadata={weights.KEY: text}))


def put_changed(path, name, tensor):
    """The file again with another tensor of that name, or without it (None)."""
    tensors, metadata = parts_of(path)
    tensors.pop(name, None)
    put(path, tensors if tensor is None else {**tensors, name: tensor}, metadata)


def refused(path, *phrases):
    """Whoever reads it gets one line that names the file and holds these phrases."""
    for reads in (weights.read, policies.load):
        with pytest.raises(BufgymError) as error:
            reads(path)
        message = str(error.value)
        assert message.startswith(f"{path}: ") and "\n" not in message
        for phrase in phrases:
            assert phrase in message

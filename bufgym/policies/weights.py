"""Learned policies in files: safetensors with JSON metadata, which no code is run to read.

The tensors are those of ``learned.Weights``, float32, by name: ``drop.skip`` [inputs], ``drop.bias`` [1], for each
hidden layer ``drop.0.weight`` [inputs, outputs] and ``drop.0.bias`` [outputs], ``drop.out`` [outputs of the last];
``accept.*`` likewise, and ``send.*`` in a scheduler's (``learned_topics``). The header's metadata has one entry,
``bufgym``, a JSON object: what the file says of itself.

    format        number of this format
    name          the policy's
    about         a sentence: what it does (may be absent)
    fields        the observation's fields that it reads, in the order of the networks' inputs
    observation   hash of the table that defines them (``bufgym.observe.FIELDS``)
    bufgym        version that wrote the file
    sha256        of fields and tensors

and whatever its maker notes: the command it was trained with, seeds, suite, scores. A file is taken whole or refused.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np
import safetensors
from numpy.typing import NDArray
from safetensors.numpy import save as serialized

from bufgym import __version__
from bufgym.errors import BufgymError, where
from bufgym.files import replaced
from bufgym.observe import FIELDS, TOPIC_FIELDS
from bufgym.policies import learned, learned_topics
from bufgym.policies.learned import FORMAT, MAX_BYTES, MAX_WIDTH, NAMES, Network, Weights
from bufgym.policies.learned_topics import TopicWeights
from bufgym.policies.registry import Policy

StrPath = str | os.PathLike[str]
Tensors = dict[str, NDArray[np.float32]]

KEY = "bufgym"
"""The entry of the header's metadata that holds the JSON text."""
WRITTEN = ("format", "fields", "observation", "bufgym", "sha256")
"""What ``save`` itself writes into the metadata."""
MIX = "drop.mix"
"""A tensor that a file may lack."""
STILL = "still."
"""Before the names of the second scorer's tensors, whose hidden layers are its own; a file may lack them all."""
LAYERS = {False: 2, True: 1}
"""Hidden layers at most; True: of a scheduler."""
SEND = "send"
"""The network that a scheduler alone has."""


def observation_hash(topics: bool = False) -> str:
    """SHA-256 of what the fields are and mean: weights trained on other definitions decide nonsense.

    ``topics``: with the fields that there are with several topics.
    """
    fields = FIELDS + TOPIC_FIELDS if topics else FIELDS
    table = [(field.name, field.per, field.unit, field.meaning) for field in fields]
    return hashlib.sha256(json.dumps(table).encode()).hexdigest()


def load(path: StrPath) -> Policy:
    """The policy in a file, for every L; it runs compiled, as the built-in ones do.

    Raises:
        BufgymError: no such file, or one that breaks a rule of the format.
    """
    weights, metadata = read_any(path)
    source = f"{Path(path).name}, sha256 {metadata['sha256'][:12]}"
    given = metadata["name"], metadata.get("about", ""), source
    if isinstance(weights, TopicWeights):
        return learned_topics.policy(given[0], weights, *given[1:])
    return learned.policy(given[0], weights, *given[1:])


def load_shipped(name: str, path: Path) -> Policy:
    """One of the agents that come with bufgym; file and metadata call it the same."""
    policy = load(path)
    if policy.name != name:
        raise BufgymError(where(path, None, policy.name, f"must be {name}, as the file", field="name"))
    return policy


# --- writing ---------------------------------------------------------------------------------------------------------


def save(path: StrPath, weights: Weights | TopicWeights, about: Mapping[str, Any]) -> Path:
    """Write a learned policy, whole or not at all.

    Args:
        path: the file; one that is there is replaced.
        about: ``name`` of the policy, ``about`` (a sentence), and what else its maker notes, as JSON can hold it.

    Raises:
        BufgymError: the file cannot be written, or could not be read again.
    """
    target = Path(path)
    tensors = dict(_tensors(weights))
    reserved = sorted(set(WRITTEN) & set(about))
    if reserved:
        raise BufgymError(f"{target}: metadata {', '.join(reserved)}: written by save itself")
    metadata = {
        "format": FORMAT,
        **about,
        "fields": list(weights.fields),
        "observation": observation_hash(isinstance(weights, TopicWeights)),
        "bufgym": __version__,
        "sha256": _sha256(weights.fields, tensors),
    }
    try:
        text = json.dumps(metadata, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise BufgymError(f"{target}: metadata that JSON cannot hold: {error}") from None
    data = serialized(tensors, metadata={KEY: text})
    _parsed(target, data)  # what could not be read is not written
    try:
        with replaced(target) as temporary:
            temporary.write_bytes(data)
    except OSError as error:
        raise BufgymError(f"{target}: cannot be written: {error.strerror}") from None
    return target


def _tensors(weights: Weights | TopicWeights) -> Iterator[tuple[str, NDArray[np.float32]]]:
    networks = {"drop": weights.drop, "accept": weights.accept}
    if isinstance(weights, TopicWeights):
        networks[SEND] = weights.send
    elif weights.still is not None:
        yield from ((f"{STILL}{name}", tensor) for name, tensor in _tensors(weights.still))
    for prefix, network in networks.items():
        yield f"{prefix}.skip", _plain(network.skip)
        yield f"{prefix}.bias", _plain(network.bias)
        for i, (weight, bias) in enumerate(network.layers):
            yield f"{prefix}.{i}.weight", _plain(weight)
            yield f"{prefix}.{i}.bias", _plain(bias)
        yield f"{prefix}.out", _plain(network.out)
    if isinstance(weights, Weights) and weights.mix is not None:
        yield MIX, _plain(weights.mix)


def _plain(array: NDArray[Any]) -> NDArray[np.float32]:
    """Little-endian and in C order, as in the file."""
    return np.ascontiguousarray(array, "<f4")


def _sha256(fields: Sequence[str], tensors: Tensors) -> str:
    """Over the fields, and the tensors' names, shapes and bytes in the order of the names."""
    state = hashlib.sha256(",".join(fields).encode())
    for name in sorted(tensors):
        state.update(f"{name}{list(tensors[name].shape)}".encode())
        state.update(tensors[name].tobytes())
    return state.hexdigest()


# --- reading ---------------------------------------------------------------------------------------------------------


def read(path: StrPath) -> tuple[Weights, dict[str, Any]]:
    """(weights, metadata) of a one-queue slot scorer's file that ``save`` wrote.

    Raises:
        BufgymError: no such file, or one that breaks a rule of the format.
    """
    weights, metadata = read_any(path)
    if isinstance(weights, TopicWeights):
        raise BufgymError(f"{path}: a scheduler for several topics, not a policy for one queue")
    return weights, metadata


def read_any(path: StrPath) -> tuple[Weights | TopicWeights, dict[str, Any]]:
    """The same of either kind."""
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise BufgymError(f"{path}: cannot be read: {error.strerror}") from None
    return _parsed(path, data)


def _parsed(path: StrPath, data: bytes) -> tuple[Weights | TopicWeights, dict[str, Any]]:
    if len(data) > MAX_BYTES:
        raise BufgymError(f"{path}: larger than the {MAX_BYTES} bytes that a learned policy may have")
    try:
        found = cast(Any, safetensors).deserialize(data)
    except safetensors.SafetensorError as error:
        raise BufgymError(f"{path}: no safetensors file, or a broken one: {error}") from None
    topics = any(name.startswith(f"{SEND}.") for name, _ in found)
    metadata = _metadata(path, data, topics)
    tensors = _checked_tensors(path, found, metadata["fields"], topics)
    if _sha256(metadata["fields"], tensors) != metadata["sha256"]:
        rule = "fields and tensors have another one: the file was changed"
        raise BufgymError(where(path, None, metadata["sha256"], rule, field="sha256"))
    if topics:
        networks = [_network(prefix, tensors) for prefix in ("drop", "accept", SEND)]
        return TopicWeights(tuple(metadata["fields"]), *networks), metadata
    other = {name.removeprefix(STILL): tensor for name, tensor in tensors.items() if name.startswith(STILL)}
    own = {name: tensor for name, tensor in tensors.items() if not name.startswith(STILL)}
    made = _weights(metadata["fields"], own)
    return (replace(made, still=_weights(metadata["fields"], other)) if other else made), metadata


def _weights(fields: Sequence[str], tensors: Tensors) -> Weights:
    mix = tensors.pop(MIX).astype(np.float32) if MIX in tensors else None
    return Weights(tuple(fields), _network("drop", tensors), _network("accept", tensors), mix)


def _metadata(path: StrPath, data: bytes, topics: bool) -> dict[str, Any]:
    """The JSON object in the header, its rules checked."""
    # 8 bytes: the header's length; then the header, which the library has read without complaint.
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    text = header.get("__metadata__", {}).get(KEY)
    if text is None:
        raise BufgymError(f"{path}: has no metadata of bufgym's; no file of a learned policy")
    try:
        metadata = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise BufgymError(f"{path}: metadata that are no JSON: {error}") from None
    if not isinstance(metadata, dict):
        raise BufgymError(f"{path}: metadata must be a JSON object")

    def refuse(key: str, rule: str) -> NoReturn:
        raise BufgymError(where(path, None, metadata.get(key, "(absent)"), rule, field=key))

    if metadata.get("format") != FORMAT:
        refuse("format", f"this bufgym reads format {FORMAT}")
    for key in ("name", "observation", "bufgym", "sha256"):
        if not isinstance(metadata.get(key), str):
            refuse(key, "must be text")
    name, about, fields = metadata["name"], metadata.get("about", ""), metadata.get("fields")
    if not name or not name.isprintable() or any(c in ":,= " for c in name):
        refuse("name", "must be non-empty, without spaces, ':', ',' or '='")
    if not isinstance(about, str) or not about.isprintable():
        refuse("about", "must be one line of text")
    if metadata["observation"] != observation_hash(topics):
        made = f"(bufgym {metadata['bufgym']} wrote it, this is {__version__})"
        refuse("observation", f"trained on other observations than this bufgym's: train it again {made}")
    if not isinstance(fields, list) or not fields:
        refuse("fields", "must be a list of at least one field")
    names = learned_topics.NAMES if topics else NAMES
    for field in fields:
        if field not in names:
            raise BufgymError(where(path, None, field, f"unknown; known: {', '.join(names)}", field="field"))
        if fields.count(field) > 1:
            raise BufgymError(where(path, None, field, "given more than once", field="field"))
    return metadata


def _no_number(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON's")


def _checked_tensors(
    path: StrPath, found: list[tuple[str, dict[str, Any]]], fields: list[str], topics: bool
) -> Tensors:
    """The tensors by name, each of them float32, finite, and of the shape that the others ask for."""

    def refuse(name: str, rule: str, *, what: str = "", value: object = None) -> NoReturn:
        raise BufgymError(where(path, None, value, rule, field=f"{what}tensor {name}"))

    def refuse_shape(name: str, rule: str) -> NoReturn:
        refuse(name, rule, what="shape of ", value=list(given[name]))

    given = {name: tuple(info["shape"]) for name, info in found}
    inputs = len(fields)
    networks = ("drop", "accept", SEND) if topics else ("drop", "accept")
    for which in ("", STILL) if not topics and any(name.startswith(STILL) for name in given) else ("",):
        widths: list[int] = []
        for i in range(LAYERS[topics]):
            name = f"{which}drop.{i}.bias"
            if name not in given:
                if f"{which}drop.{i}.weight" in given:
                    refuse(name, "is missing")
                break
            if len(given[name]) != 1 or not 1 <= given[name][0] <= MAX_WIDTH:
                refuse_shape(name, f"must be one number for each of 1 to {MAX_WIDTH} hidden units")
            widths += given[name]
        own = {which + name: shape for name, shape in _shapes(networks, inputs, widths).items()}
        if which + MIX in given and not topics:
            slots = sum(NAMES.index(name) < learned.SLOTS for name in fields)
            own[which + MIX] = (inputs - slots, slots)
        for name in [*own, *given]:
            if name not in given:
                refuse(name, "is missing")
            if name not in own and (topics or name.startswith(STILL) == bool(which)):
                refuse(name, f"has no place in networks of {len(widths)} hidden layers ({LAYERS[topics]} at most)")
        for name, shape in own.items():
            if given[name] != shape:
                refuse_shape(name, f"must be {list(shape)} for {inputs} fields and hidden layers of {widths}")
    tensors: Tensors = {}
    for name, info in found:
        if info["dtype"] != "F32":
            refuse(name, "must be F32", what="type of ", value=info["dtype"])
        tensors[name] = np.frombuffer(bytes(info["data"]), "<f4").reshape(given[name])
        if not np.isfinite(tensors[name]).all():
            refuse(name, "must hold finite numbers alone")
    return tensors


def _shapes(networks: Sequence[str], inputs: int, widths: list[int]) -> dict[str, tuple[int, ...]]:
    """Name -> shape of every tensor."""
    shapes: dict[str, tuple[int, ...]] = {}
    for prefix in networks:
        shapes |= {f"{prefix}.skip": (inputs,), f"{prefix}.bias": (1,)}
        for i, (a, b) in enumerate(itertools.pairwise([inputs, *widths])):
            shapes |= {f"{prefix}.{i}.weight": (a, b), f"{prefix}.{i}.bias": (b,)}
        shapes[f"{prefix}.out"] = (widths[-1] if widths else 0,)
    return shapes


def _network(prefix: str, tensors: Tensors) -> Network:
    # Arrays of their own: those over the file's bytes cannot be written.
    own = {name: tensor.astype(np.float32) for name, tensor in tensors.items() if name.startswith(f"{prefix}.")}
    layers = tuple((own[f"{prefix}.{i}.weight"], own[f"{prefix}.{i}.bias"]) for i in range((len(own) - 3) // 2))
    return Network(own[f"{prefix}.skip"], own[f"{prefix}.bias"], layers, own[f"{prefix}.out"])

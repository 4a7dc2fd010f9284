"""Learned policies in files: safetensors with JSON metadata, which is read without running code.

See docs/methods.md, "The file of an agent".
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import safetensors
from numpy.typing import NDArray
from safetensors.numpy import save as serialized

from bufgym.policies.candidate_network import CandidateWeights
from bufgym.policies.learned import Weights
from bufgym.policies.registry import Policy
from bufgym.policies.ruled_network import RuledWeights
from bufgym.utils import __version__, strict_json
from bufgym.utils.errors import BufgymError, where
from bufgym.utils.files import read_whole, replaced

StrPath = str | os.PathLike[str]
Tensors = dict[str, NDArray[np.float32]]
AnyWeights = Weights | CandidateWeights
Kind = type[Weights] | type[CandidateWeights]

FORMAT = 1
MAX_BYTES = 1 << 20  # Largest file accepted, bytes: a slot scorer has a few kilobytes
MAX_WIDTH = 256  # Most units of a hidden layer
KEY = "bufgym"  # The entry of the header's metadata that holds the JSON text
GONE = {
    "scheduler": "numbers that moved a rule's: python train.py tune gap-priority finds such numbers now",
    "guided": "numbers that moved a rule's: python train.py tune gap-price finds such numbers now",
    "ruled": "a network that sees no past: python train.py hindsight makes one that does",
}
"""A network that files had -> what it was, and what takes its place."""
WRITTEN = ("format", "fields", "observation", "bufgym", "sha256")  # Metadata that ``save`` itself writes


def observation_hash(kind: Kind, fields: Sequence[str] = ()) -> str:
    """SHA-256 of the fields' definitions: weights trained on other definitions would decide nonsense."""
    return hashlib.sha256(json.dumps(kind.definition(fields)).encode()).hexdigest()


def load(path: StrPath) -> Policy:
    """Load the policy in a file, for every L; it runs compiled, like built-in policies.

    Raises:
        BufgymError: no such file, or one that breaks a rule of the format.
    """
    weights, metadata = read(path)
    source = f"{Path(path).name}, sha256 {metadata['sha256'][:12]}"
    return weights.policy(metadata["name"], metadata.get("about", ""), source)


def save(path: StrPath, weights: AnyWeights, about: Mapping[str, Any]) -> Path:
    """Write a learned policy, whole or not at all.

    ``about`` holds the policy's ``name``, ``about`` (a sentence), and further notes of the author that JSON can hold.

    Raises:
        BufgymError: the file cannot be written, or could not be read again.
    """
    # Little-endian and in C order, as in the file.
    target, tensors = Path(path), {n: np.ascontiguousarray(t, "<f4") for n, t in weights.tensors().items()}
    settings = {name: getattr(weights, name) for name in weights.SETTINGS}
    reserved = sorted({*WRITTEN, *settings} & set(about))
    if reserved:
        raise BufgymError(f"{target}: metadata {', '.join(reserved)}: written by save itself")
    metadata = {
        "format": FORMAT,
        **about,
        "fields": list(weights.fields),
        **settings,
        "observation": observation_hash(type(weights), weights.fields),
        "bufgym": __version__,
        "sha256": _sha256(weights.fields, settings, tensors),
    }
    try:
        text = json.dumps(metadata, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise BufgymError(f"{target}: metadata that JSON cannot hold: {error}") from None
    data = serialized(tensors, metadata={KEY: text})
    _parsed(target, data)  # an unreadable file is never written
    try:
        with replaced(target) as temporary:
            temporary.write_bytes(data)
    except OSError as error:
        raise BufgymError(f"{target}: cannot be written: {error.strerror}") from None
    return target


def _sha256(fields: Sequence[str], settings: Mapping[str, Any], tensors: Tensors) -> str:
    """Hash of the fields, the settings, and the tensors' names, shapes and bytes in the order of the names."""
    state = hashlib.sha256(",".join(fields).encode())
    for name, value in settings.items():
        state.update(f"{name}={json.dumps(value)}".encode())
    for name in sorted(tensors):
        state.update(f"{name}{list(tensors[name].shape)}".encode())
        state.update(tensors[name].tobytes())
    return state.hexdigest()


def read(path: StrPath) -> tuple[AnyWeights, dict[str, Any]]:
    """(weights, metadata) of a file that ``save`` wrote.

    Raises:
        BufgymError: no such file, or one that breaks a rule of the format.
    """
    return _parsed(path, read_whole(path, MAX_BYTES))


def _parsed(path: StrPath, data: bytes) -> tuple[AnyWeights, dict[str, Any]]:
    if len(data) > MAX_BYTES:
        raise BufgymError(f"{path}: larger than the {MAX_BYTES} bytes that a learned policy may have")
    try:
        entries = dict(cast(Any, safetensors).deserialize(data))
    except safetensors.SafetensorError as error:
        raise BufgymError(f"{path}: no safetensors file, or a broken one: {error}") from None
    prefixes = {name.partition(".")[0] for name in entries}
    for network, now in GONE.items():
        if network in prefixes:
            raise BufgymError(f"{path}: made by bufgym until 0.2: {now}")
    kinds: tuple[Kind, ...] = (CandidateWeights, RuledWeights)
    kind = next((kind for kind in kinds if kind.NETWORKS[0] in prefixes), Weights)
    metadata = _metadata(path, data, kind)
    fields, settings = metadata["fields"], {name: metadata[name] for name in kind.SETTINGS}
    tensors = _checked_tensors(path, entries, fields, settings, kind)
    if _sha256(fields, settings, tensors) != metadata["sha256"]:
        rule = "fields, settings and tensors have another one: the file was changed"
        raise _wrong(path, "sha256", rule, metadata["sha256"])
    return kind.of(fields, tensors, settings), metadata


def _metadata(path: StrPath, data: bytes, kind: Kind) -> dict[str, Any]:
    """The JSON object in the header, checked."""
    # 8 bytes hold the header's length; then comes the header, which the library has read without complaint.
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    text = (header.get("__metadata__") or {}).get(KEY)
    if text is None:
        raise BufgymError(f"{path}: has no metadata of bufgym's; no file of a learned policy")
    try:
        metadata = strict_json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BufgymError(f"{path}: metadata that are no JSON: {error}") from None
    if not isinstance(metadata, dict):
        raise BufgymError(f"{path}: metadata must be a JSON object")

    def wrong(key: str, rule: str) -> BufgymError:
        return _wrong(path, key, rule, metadata.get(key, "(absent)"))

    if metadata.get("format") != FORMAT:
        raise wrong("format", f"this bufgym reads format {FORMAT}")
    for key in ("name", "observation", "bufgym", "sha256"):
        if not isinstance(metadata.get(key), str):
            raise wrong(key, "must be text")
    name, about, fields = metadata["name"], metadata.get("about", ""), metadata.get("fields")
    if not name or not name.isprintable() or any(c in ":,= " for c in name):
        raise wrong("name", "must be non-empty, without spaces, ':', ',' or '='")
    if not isinstance(about, str) or not about.isprintable():
        raise wrong("about", "must be one line of text")
    if metadata["observation"] != observation_hash(kind, fields if isinstance(fields, list) else ()):
        versions = f"(bufgym {metadata['bufgym']} wrote it, this is {__version__})"
        raise wrong("observation", f"trained on other observations than this bufgym's: train it again {versions}")
    if not isinstance(fields, list) or not fields:
        raise wrong("fields", "must be a list of at least one field")
    known = (*kind.SLOT_NAMES, *kind.CONTEXT_NAMES)
    for field in fields:
        if field not in known:
            raise _wrong(path, "field", f"unknown; known: {', '.join(known)}", field)
        if fields.count(field) > 1:
            raise _wrong(path, "field", "given more than once", field)
    for key, (holds, rule) in kind.SETTINGS.items():
        if not holds(metadata.get(key)):
            raise wrong(key, rule)
    if issubclass(kind, CandidateWeights) and tuple(fields) != known:
        raise wrong("fields", f"must be {', '.join(known)}")
    return metadata


def _wrong(path: StrPath, what: str, rule: str, value: object = None) -> BufgymError:
    """The error that ``what`` in the file breaks a rule."""
    return BufgymError(where(path, None, value, rule, field=what))


def _checked_tensors(
    path: StrPath, entries: dict[str, Any], fields: Sequence[str], settings: Mapping[str, Any], kind: Kind
) -> Tensors:
    """Name -> tensor; each is float32, finite, and of the shape that the others require."""
    shapes = {name: tuple(entry["shape"]) for name, entry in entries.items()}
    _check_shapes(path, shapes, fields, settings, kind)
    tensors: Tensors = {}
    for name, entry in entries.items():
        if entry["dtype"] != "F32":
            raise _wrong(path, f"type of tensor {name}", "must be F32", entry["dtype"])
        # A copy: an array over the file's bytes could not be written to.
        tensors[name] = np.frombuffer(bytes(entry["data"]), "<f4").reshape(shapes[name]).copy()
        if not np.isfinite(tensors[name]).all():
            raise _wrong(path, f"tensor {name}", "must hold finite numbers alone")
    return tensors


def _check_shapes(
    path: StrPath, shapes: Mapping[str, tuple[int, ...]], fields: Sequence[str], settings: Mapping[str, Any], kind: Kind
) -> None:
    """Check that the tensors are complete and fit each other."""

    def misshapen(name: str, rule: str) -> BufgymError:
        return _wrong(path, f"shape of tensor {name}", rule, list(shapes[name]))

    widths: list[int] = []
    for k in range(kind.LAYERS):
        layer = f"{kind.NETWORKS[0]}.{k}"
        name = f"{layer}.bias"
        if name not in shapes:
            if f"{layer}.weight" in shapes:
                raise _wrong(path, f"tensor {name}", "is missing")
            break
        if len(shapes[name]) != 1 or not 1 <= shapes[name][0] <= MAX_WIDTH:
            raise misshapen(name, f"must be one number for each of 1 to {MAX_WIDTH} hidden units")
        widths += shapes[name]
    required = kind.shapes(fields, widths, shapes, settings)
    for name in (*required, *shapes):
        if name not in shapes:
            raise _wrong(path, f"tensor {name}", "is missing")
        if name not in required:
            rule = f"has no place in networks of {len(widths)} hidden layers ({kind.LAYERS} at most)"
            raise _wrong(path, f"tensor {name}", rule)
    for name, shape in required.items():
        if shapes[name] != shape:
            raise misshapen(
                name, f"must be {list(shape)} for {kind.inputs_text(fields, settings)} and hidden layers of {widths}"
            )

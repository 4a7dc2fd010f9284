"""Broken files of weights: whatever is wrong with one is said in one line, and nothing of it is used."""

from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import save as safetensors
from weight_cases import ABOUT, KINDS, QUEUE, TOPICS, made, parts_of, put, put_changed, refused

from bufgym.policies import weights


@pytest.fixture
def path(tmp_path):
    return tmp_path / "small.safetensors"


def test_what_is_no_file_of_weights_is_refused(path):
    refused(path, "no such file")
    refused(path.parent, "must be a regular file")
    with open(path, "wb") as file:
        file.truncate(1 << 40)
    refused(path, f"larger than {weights.MAX_BYTES} bytes")  # and not read to its end
    for data in (b"hello", b"PK\x03\x04" * 20, b"\xff" * 64, (2).to_bytes(8, "little") + b"{]"):
        path.write_bytes(data)
        refused(path, "no safetensors file, or a broken one")
    for metadata in (None, {"format": "pt"}):
        path.write_bytes(safetensors({"weight": np.zeros(3, np.float32)}, metadata=metadata))
        refused(path, "no metadata of bufgym's")


@pytest.mark.parametrize("kind", KINDS)
def test_a_truncated_or_changed_file_is_refused(path, kind):
    weights.save(path, made(3, kind=kind), ABOUT)
    data = bytearray(path.read_bytes())
    for keep in (0, 7, 8, 100, -1):
        path.write_bytes(data[:keep])
        refused(path, "no safetensors file, or a broken one")
    data[-4] ^= 1
    path.write_bytes(data)
    refused(path, "sha256", "fields and tensors have another one")


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("{", "no JSON"),
        ('{"format": NaN}', "NaN is no number"),
        ("[" * 100_000, "no JSON"),
        ("[1]", "must be a JSON object"),
        ("{}", "format = (absent)"),
    ],
)
def test_metadata_that_are_no_json_object_are_refused(path, text, rule):
    weights.save(path, made(3), ABOUT)
    put(path, parts_of(path)[0], text)
    refused(path, rule)


@pytest.mark.parametrize(
    ("kind", "key", "value", "rule"),
    [
        (QUEUE, "format", 2, "format = 2: this bufgym reads format 1"),
        (QUEUE, "format", "1", "format = 1: this bufgym reads format 1"),
        (QUEUE, "name", 3, "name = 3: must be text"),
        (QUEUE, "name", "\u001b[31mred", "must be non-empty"),
        (QUEUE, "name", "\ud800", "must be non-empty"),
        (QUEUE, "about", ["no", "text"], "must be one line of text"),
        (QUEUE, "bufgym", None, "must be text"),
        (QUEUE, "shortcuts", 1, "shortcuts = 1: must be true or false"),
        (TOPICS, "shortcuts", True, "shortcuts = True: is for one queue, not for several topics"),
        (QUEUE, "observation", "0" * 64, "trained on other observations than this bufgym's: train it again"),
        (TOPICS, "observation", weights.observation_hash(), "trained on other observations than this bufgym's"),
        (QUEUE, "fields", "time_merged", "must be a list of at least one field"),
        (TOPICS, "fields", [], "must be a list of at least one field"),
        (QUEUE, "fields", ["time_merged", ["service_ratio"]], "unknown; known: occupied, rank"),
        (QUEUE, "fields", ["service_ratio", "service_ratio"], "field = service_ratio: given more than once"),
        (QUEUE, "fields", ["service_ratio"], "must be [1] for 1 fields and hidden layers of [3]"),
        (TOPICS, "fields", ["waited", "service_ratio", "speed"], "field = speed: unknown; known: occupied"),
        (TOPICS, "fields", ["service_ratio", "waited", "gain"], "the file was changed"),
        *((QUEUE, key, "absent", key) for key in ("format", "name", "fields", "observation", "bufgym", "sha256")),
    ],
)
def test_metadata_that_break_a_rule_are_refused(path, kind, key, value, rule):
    weights.save(path, made(3, kind=kind), ABOUT)
    tensors, metadata = parts_of(path)
    metadata[key] = value
    if value == "absent":
        del metadata[key]
    put(path, tensors, metadata)
    refused(path, rule, *(["absent"] if value == "absent" else []))


def test_a_changed_meaning_of_a_field_refuses_older_weights(path, monkeypatch):
    weights.save(path, made(3), ABOUT)
    first, *others = weights.FIELDS
    monkeypatch.setattr(weights, "FIELDS", (replace(first, meaning=first.meaning + " now"), *others))
    refused(path, "trained on other observations")


def numbers(*shape, kind=np.float32):
    return np.zeros(shape, kind)


@pytest.mark.parametrize(
    ("kind", "name", "tensor", "rule"),
    [
        (QUEUE, "drop.skip", None, "tensor drop.skip is missing"),
        (QUEUE, "accept.0.weight", None, "tensor accept.0.weight is missing"),
        (QUEUE, "drop.0.bias", None, "tensor drop.0.bias is missing"),
        (QUEUE, "drop.1.bias", numbers(3), "tensor drop.1.weight is missing"),
        (QUEUE, "drop.2.bias", numbers(3), "tensor drop.2.bias has no place in networks of 1 hidden layers"),
        (QUEUE, "critic", numbers(3), "tensor critic has no place"),
        (QUEUE, "drop.skip", numbers(3), "shape of tensor drop.skip = [3]: must be [2]"),
        (QUEUE, "drop.skip", numbers(2, 1), "shape of tensor drop.skip = '[2, 1]': must be [2]"),
        (QUEUE, "drop.bias", numbers(), "shape of tensor drop.bias = []: must be [1]"),
        (QUEUE, "drop.mix", numbers(1, 2), "shape of tensor drop.mix = '[1, 2]': must be [1, 1]"),
        (QUEUE, "accept.mix", numbers(1, 1), "tensor accept.mix has no place"),
        (QUEUE, "drop.0.bias", numbers(0), "1 to 256 hidden units"),
        (QUEUE, "drop.0.bias", numbers(257), "1 to 256 hidden units"),
        (QUEUE, "drop.0.bias", numbers(3, 1), "1 to 256 hidden units"),
        (QUEUE, "drop.out", numbers(3, kind=np.float64), "type of tensor drop.out = F64: must be F32"),
        (QUEUE, "drop.out", np.float32([0, np.nan, 0]), "tensor drop.out must hold finite numbers alone"),
        (QUEUE, "accept.out", np.float32([0, 0, -np.inf]), "tensor accept.out must hold finite numbers alone"),
        (QUEUE, "still.drop.out", numbers(3), "shape of tensor still.drop.out = [3]: must be [5]"),
        (QUEUE, "still.accept.0.weight", numbers(2, 3), "must be [2, 5] for 2 fields and hidden layers of [5]"),
        (QUEUE, "still.drop.0.bias", numbers(257), "1 to 256 hidden units"),
        (QUEUE, "still.drop.1.weight", numbers(5, 4), "tensor still.drop.1.bias is missing"),
        (QUEUE, "still.drop.mix", numbers(1, 2), "shape of tensor still.drop.mix = '[1, 2]': must be [1, 1]"),
        (QUEUE, "still.still.drop.bias", numbers(1), "tensor still.still.drop.bias has no place"),
        (TOPICS, "send.skip", None, "tensor send.skip is missing"),
        (TOPICS, "send.0.weight", numbers(3, 5), "tensor send.0.weight = '[3, 5]': must be [3, 3]"),
        (TOPICS, "drop.1.bias", numbers(2), "no place in networks of 1 hidden layers (1 at most)"),
        (TOPICS, "drop.mix", numbers(1, 2), "tensor drop.mix has no place"),
        (TOPICS, "still.send.bias", numbers(1), "tensor still.send.bias has no place"),
        (TOPICS, "send.bias", np.float32([np.nan]), "tensor send.bias must hold finite numbers alone"),
    ],
)
def test_tensors_that_break_a_rule_are_refused(path, kind, name, tensor, rule):
    before = made(3, kind=kind)
    weights.save(path, replace(before, still=made(5)) if name.startswith("still.") and kind is QUEUE else before, ABOUT)
    put_changed(path, name, tensor)
    refused(path, rule)

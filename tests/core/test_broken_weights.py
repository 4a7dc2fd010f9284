"""Broken files of weights: whatever is wrong with one is said in one line, and nothing of it is used."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save as safetensors
from weight_cases import ABOUT, FIELDS, KINDS, QUEUE, TOPICS, made, parts_of, put, put_changed, refused

from bufgym.errors import BufgymError
from bufgym.policies import learned, weights


@pytest.fixture
def path(tmp_path):
    return tmp_path / "small.safetensors"


@pytest.fixture
def parts(path):
    """The tensors and the metadata of a valid file for one queue."""
    weights.save(path, made(3), ABOUT)
    return parts_of(path)


def test_a_missing_file_or_a_folder_is_refused(path):
    refused(path, "no such file")
    refused(path.parent, "must be a regular file")


def test_a_file_too_large_is_refused_and_not_read_to_its_end(path):
    with open(path, "wb") as file:
        file.truncate(1 << 40)
    refused(path, f"larger than {weights.MAX_BYTES} bytes")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keep", [0, 7, 8, 100, -1])
def test_a_truncated_file_is_refused(path, kind, keep):
    weights.save(path, made(3, kind=kind), ABOUT)
    path.write_bytes(path.read_bytes()[:keep])
    refused(path, "no safetensors file, or a broken one")


@pytest.mark.parametrize("data", [b"hello", b"PK\x03\x04" * 20, b"\xff" * 64, (2).to_bytes(8, "little") + b"{]"])
def test_what_is_no_safetensors_is_refused(path, data):
    path.write_bytes(data)
    refused(path, "no safetensors file, or a broken one")


def test_a_safetensors_file_of_another_program_is_refused(path):
    path.write_bytes(safetensors({"weight": np.zeros(3, np.float32)}))
    refused(path, "no metadata of bufgym's")
    path.write_bytes(safetensors({"weight": np.zeros(3, np.float32)}, metadata={"format": "pt"}))
    refused(path, "no metadata of bufgym's")


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("", "no JSON"),
        ("{", "no JSON"),
        ('{"format": NaN}', "NaN is no number"),
        ("[" * 100_000, "no JSON"),
        ("[1]", "must be a JSON object"),
        ("{}", "format = (absent)"),
    ],
)
def test_metadata_that_are_no_json_object_are_refused(path, parts, text, rule):
    put(path, parts[0], text)
    refused(path, rule.split(" = ")[0], rule.split(" = ")[-1])


@pytest.mark.parametrize(
    ("kind", "key", "value", "rule"),
    [
        (QUEUE, "format", 2, "format = 2: this bufgym reads format 1"),
        (QUEUE, "format", "1", "format = 1: this bufgym reads format 1"),
        (QUEUE, "name", 3, "name = 3: must be text"),
        (QUEUE, "name", "", "must be non-empty"),
        (QUEUE, "name", "\u001b[31mred", "must be non-empty"),
        (QUEUE, "name", "\ud800", "must be non-empty"),
        (QUEUE, "about", ["no", "text"], "must be one line of text"),
        (QUEUE, "bufgym", None, "must be text"),
        (QUEUE, "shortcuts", 1, "shortcuts = 1: must be true or false"),
        (TOPICS, "shortcuts", True, "shortcuts = True: is for one queue, not for several topics"),
        (QUEUE, "observation", "0" * 64, "trained on other observations than this bufgym's: train it again"),
        (QUEUE, "fields", "time_merged", "must be a list of at least one field"),
        (QUEUE, "fields", [], "must be a list of at least one field"),
        (QUEUE, "fields", ["time_merged", "speed"], "field = speed: unknown; known: occupied, rank"),
        (QUEUE, "fields", ["time_merged", ["service_ratio"]], "unknown; known: occupied, rank"),
        (QUEUE, "fields", ["service_ratio", "service_ratio"], "field = service_ratio: given more than once"),
        (QUEUE, "fields", ["service_ratio"], "must be [1] for 1 fields and hidden layers of [3]"),
        (TOPICS, "fields", ["waited", "service_ratio", "speed"], "field = speed: unknown; known: occupied"),
        (TOPICS, "fields", ["waited", "service_ratio", "service_ratio"], "field = service_ratio: given more than once"),
        (TOPICS, "fields", ["waited", "service_ratio"], "must be [2] for 2 fields"),
        (TOPICS, "fields", ["service_ratio", "waited", "gain"], "the file was changed"),
        (TOPICS, "fields", [], "must be a list of at least one field"),
        (TOPICS, "observation", weights.observation_hash(), "trained on other observations than this bufgym's"),
        (TOPICS, "format", 2, "this bufgym reads format 1"),
    ],
)
def test_metadata_that_break_a_rule_are_refused(path, kind, key, value, rule):
    weights.save(path, made(3, kind=kind), ABOUT)
    tensors, metadata = parts_of(path)
    put(path, tensors, {**metadata, key: value})
    refused(path, rule)


@pytest.mark.parametrize("key", ["format", "name", "fields", "observation", "bufgym", "sha256"])
def test_metadata_that_lack_something_are_refused(path, parts, key):
    tensors, metadata = parts
    put(path, tensors, {name: value for name, value in metadata.items() if name != key})
    refused(path, key, "absent")


def test_observations_defined_otherwise_are_told_apart(path, monkeypatch):
    """One word more in a field's meaning, and weights trained before are refused."""
    weights.save(path, made(3), ABOUT)
    first, *others = weights.FIELDS
    monkeypatch.setattr(weights, "FIELDS", (replace(first, meaning=first.meaning + " now"), *others))
    refused(path, "trained on other observations")


@pytest.mark.parametrize(
    ("kind", "name", "tensor", "rule"),
    [
        (QUEUE, "drop.skip", None, "tensor drop.skip is missing"),
        (QUEUE, "accept.0.weight", None, "tensor accept.0.weight is missing"),
        (QUEUE, "drop.0.bias", None, "tensor drop.0.bias is missing"),
        (QUEUE, "accept.0.bias", None, "tensor accept.0.bias is missing"),
        (QUEUE, "drop.1.bias", np.zeros(3, np.float32), "tensor drop.1.weight is missing"),
        (
            QUEUE,
            "drop.2.bias",
            np.zeros(3, np.float32),
            "tensor drop.2.bias has no place in networks of 1 hidden layers",
        ),
        (QUEUE, "critic", np.zeros(3, np.float32), "tensor critic has no place"),
        (QUEUE, "drop.skip", np.zeros(3, np.float32), "shape of tensor drop.skip = [3]: must be [2]"),
        (QUEUE, "drop.skip", np.zeros((2, 1), np.float32), "shape of tensor drop.skip = '[2, 1]': must be [2]"),
        (QUEUE, "drop.bias", np.zeros((), np.float32), "shape of tensor drop.bias = []: must be [1]"),
        (QUEUE, "drop.mix", np.zeros((1, 2), np.float32), "shape of tensor drop.mix = '[1, 2]': must be [1, 1]"),
        (QUEUE, "accept.mix", np.zeros((1, 1), np.float32), "tensor accept.mix has no place"),
        (QUEUE, "drop.0.bias", np.zeros(0, np.float32), "1 to 256 hidden units"),
        (QUEUE, "drop.0.bias", np.zeros(257, np.float32), "1 to 256 hidden units"),
        (QUEUE, "drop.0.bias", np.zeros((3, 1), np.float32), "1 to 256 hidden units"),
        (QUEUE, "drop.out", np.zeros(3, np.float64), "type of tensor drop.out = F64: must be F32"),
        (QUEUE, "drop.out", np.zeros(3, np.float16), "type of tensor drop.out = F16: must be F32"),
        (QUEUE, "drop.out", np.float32([0, np.nan, 0]), "tensor drop.out must hold finite numbers alone"),
        (QUEUE, "accept.out", np.float32([0, 0, -np.inf]), "tensor accept.out must hold finite numbers alone"),
        (TOPICS, "send.skip", None, "tensor send.skip is missing"),
        (TOPICS, "send.0.weight", None, "tensor send.0.weight is missing"),
        (TOPICS, "drop.0.bias", None, "tensor drop.0.bias is missing"),
        (TOPICS, "accept.out", None, "tensor accept.out is missing"),
        (TOPICS, "send.skip", np.zeros(4, np.float32), "shape of tensor send.skip = [4]: must be [3]"),
        (TOPICS, "send.0.weight", np.zeros((3, 5), np.float32), "tensor send.0.weight = '[3, 5]': must be [3, 3]"),
        (TOPICS, "send.out", np.zeros(0, np.float32), "shape of tensor send.out = [0]: must be [3]"),
        (TOPICS, "send.1.weight", np.zeros((4, 2), np.float32), "tensor send.1.weight has no place"),
        (TOPICS, "drop.1.bias", np.zeros(2, np.float32), "no place in networks of 1 hidden layers (1 at most)"),
        (TOPICS, "critic.skip", np.zeros(3, np.float32), "tensor critic.skip has no place"),
        (TOPICS, "drop.mix", np.zeros((1, 2), np.float32), "tensor drop.mix has no place"),
        (TOPICS, "still.drop.bias", np.zeros(1, np.float32), "tensor still.drop.bias has no place"),
        (TOPICS, "still.send.bias", np.zeros(1, np.float32), "tensor still.send.bias has no place"),
        (TOPICS, "send.bias", np.zeros(1, np.float64), "type of tensor send.bias = F64: must be F32"),
        (TOPICS, "send.bias", np.float32([np.nan]), "tensor send.bias must hold finite numbers alone"),
    ],
)
def test_tensors_that_break_a_rule_are_refused(path, kind, name, tensor, rule):
    weights.save(path, made(3, kind=kind), ABOUT)
    put_changed(path, name, tensor)
    refused(path, rule)


@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_number_is_refused(path, kind):
    weights.save(path, made(3, kind=kind), ABOUT)
    data = bytearray(path.read_bytes())
    data[-4] ^= 1
    path.write_bytes(data)
    refused(path, "sha256", "fields and tensors have another one")


def test_fields_in_another_order_are_refused(path, parts):
    tensors, metadata = parts
    put(path, tensors, {**metadata, "fields": metadata["fields"][::-1]})
    refused(path, "sha256", "fields and tensors have another one")


SMALL = Path(tempfile.mkdtemp()) / "small.safetensors"
"""Few numbers, so that most changes meet the header."""
weights.save(SMALL, made(1), ABOUT)
VALID = SMALL.read_bytes()
FLAT = [x.tobytes() for x in (made(1).drop.flat(), made(1).accept.flat())]


@st.composite
def damaged(draw):
    """A valid file with some bytes changed, put in, taken out, or cut off."""
    data = bytearray(VALID)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(data) - 1)))
        piece = draw(
            st.one_of(st.binary(max_size=4), st.sampled_from([b'"', b"{", b"]", b"0", b"null", b"-1", b"1e9"]))
        )
        data[at : at + draw(st.integers(0, 8))] = piece
    return bytes(data[: draw(st.integers(0, len(data)))]) if draw(st.booleans()) else bytes(data)


@given(damaged())
@settings(max_examples=1000)
def test_a_damaged_file_is_read_or_refused_and_nothing_else(data):
    SMALL.write_bytes(data)
    try:
        read, metadata = weights.read(SMALL)
    except BufgymError as error:
        assert str(error).startswith(str(SMALL))
        return
    # The damage is in the notes about the weights, not in the weights themselves.
    assert [x.tobytes() for x in (read.drop.flat(), read.accept.flat())] == FLAT
    assert read.fields == FIELDS[QUEUE]
    learned.policy(metadata["name"], read).new_memory(1, 4)


@pytest.mark.parametrize(
    ("name", "tensor", "rule"),
    [
        ("still.drop.out", np.zeros(3, np.float32), "shape of tensor still.drop.out = [3]: must be [5]"),
        ("still.accept.0.weight", np.zeros((2, 3), np.float32), "must be [2, 5] for 2 fields and hidden layers of [5]"),
        ("still.drop.0.bias", np.zeros(257, np.float32), "1 to 256 hidden units"),
        ("still.drop.0.bias", None, "tensor still.drop.0.bias is missing"),
        ("still.drop.1.weight", np.zeros((5, 4), np.float32), "tensor still.drop.1.bias is missing"),
        ("still.drop.mix", np.zeros((1, 2), np.float32), "shape of tensor still.drop.mix = '[1, 2]': must be [1, 1]"),
        ("still.still.drop.bias", np.zeros(1, np.float32), "tensor still.still.drop.bias has no place"),
    ],
)
def test_a_second_scorer_that_breaks_a_rule_is_refused(path, name, tensor, rule):
    weights.save(path, replace(made(3), still=made(5)), ABOUT)
    put_changed(path, name, tensor)
    refused(path, rule)

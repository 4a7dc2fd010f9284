"""Files of weights: what is written comes back bit for bit, and whatever is wrong with a file is said in one line."""

from __future__ import annotations

import itertools
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load as tensors_of
from safetensors.numpy import save as safetensors

from bufgym import __version__, policies
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.policies import learned, registry, weights
from bufgym.policies.learned import Network, Weights
from bufgym.scenario import Interruption
from bufgym.sim import run

FIELDS = ("time_merged", "service_ratio")
ABOUT = {"name": "small", "about": "Drops what is in its way.", "seeds": [0, 1], "scores": {"regret": 0.25}}


def network(rng, inputs, *widths):
    sizes = [inputs, *widths]
    layers = tuple(
        (rng.normal(size=(a, b)).astype(np.float32), rng.normal(size=b).astype(np.float32))
        for a, b in itertools.pairwise(sizes)
    )
    out = rng.normal(size=widths[-1] if widths else 0).astype(np.float32)
    return Network(rng.normal(size=inputs).astype(np.float32), np.float32([0.5]), layers, out)


def made(*widths, fields=FIELDS, seed=0):
    rng = np.random.default_rng(seed)
    return Weights(fields, network(rng, len(fields), *widths), network(rng, len(fields), *widths))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "small.safetensors"


@pytest.fixture
def parts(path):
    """The tensors and the metadata of a valid file, to be changed and written again by ``put``."""
    weights.save(path, made(3), ABOUT)
    return tensors_of(path.read_bytes()), weights.read(path)[1]


def put(path, tensors, metadata):
    """Any tensors with any metadata."""
    text = metadata if isinstance(metadata, str) else json.dumps(metadata)
    path.write_bytes(safetensors(tensors, metadata={weights.KEY: text}))


def refused(path, *told):
    """It is refused by one line that names the file and says all this."""
    for reads in (weights.read, policies.load):
        with pytest.raises(BufgymError) as error:
            reads(path)
        message = str(error.value)
        assert message.startswith(f"{path}: ")
        assert "\n" not in message
        for each in told:
            assert each in message


# --- there and back --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("widths", [(), (1,), (8,), (16, 4), (256,)])
def test_what_is_written_comes_back_bit_for_bit(path, widths):
    before = made(*widths, fields=("service_ratio", "motion_merged", "loss"))
    assert weights.save(path, before, ABOUT) == path
    after, metadata = weights.read(path)
    assert after.fields == before.fields
    assert after.widths == before.widths
    for one, other in ((before.drop, after.drop), (before.accept, after.accept)):
        assert one.flat().tobytes() == other.flat().tobytes()
        assert [weight.shape for weight, _ in one.layers] == [weight.shape for weight, _ in other.layers]
    assert {key: metadata[key] for key in ABOUT} == ABOUT
    assert metadata["bufgym"] == __version__
    assert list(path.parent.iterdir()) == [path]
    # The same weights make the same file.
    first = path.read_bytes()
    weights.save(path, after, ABOUT)
    assert path.read_bytes() == first


def test_the_format_is_what_the_text_says(path):
    weights.save(path, made(3), ABOUT)
    shapes = {name: list(tensor.shape) for name, tensor in tensors_of(path.read_bytes()).items()}
    one = {"skip": [2], "bias": [1], "0.weight": [2, 3], "0.bias": [3], "out": [3]}
    assert shapes == {f"{net}.{name}": shape for net in ("drop", "accept") for name, shape in one.items()}


def test_a_loaded_policy_is_one_like_any_other(path):
    before = made(4)
    weights.save(path, before, ABOUT)
    policy = policies.load(path)
    assert (policy.name, policy.summary) == ("small", "Drops what is in its way.")
    assert policy.source == f"small.safetensors, sha256 {weights.read(path)[1]['sha256'][:12]}"
    assert policy.ranked
    assert policies.get(policy) is policy
    episodes = [Interruption(t_max=30).episode(T) for T in (5, 17, 30)]
    v = qoi.exponential(0.618)
    ours, same = run(policy, episodes, 4, v), run(learned.policy("same", before), episodes, 4, v)
    assert np.array_equal(np.asarray(ours.batch.log), np.asarray(same.batch.log))
    other = run(learned.policy("other", made(4, seed=2)), episodes, 4, v)
    assert not np.array_equal(np.asarray(ours.batch.log), np.asarray(other.batch.log))


# --- what is not written ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("about", "rule"),
    [
        ({"about": "No name."}, "name = (absent)"),
        ({"name": "two words"}, "name = 'two words': must be non-empty, without spaces"),
        ({"name": "a:b"}, "name = a:b: must be non-empty, without spaces"),
        ({"name": "ok", "about": "two\nlines"}, "must be one line of text"),
        ({"name": "ok", "sha256": "0"}, "sha256: written by save itself"),
        ({"name": "ok", "scores": float("nan")}, "metadata that JSON cannot hold"),
        ({"name": "ok", "scores": {1, 2}}, "metadata that JSON cannot hold"),
        ({"name": "ok", "notes": "x" * weights.MAX_BYTES}, "larger than"),
    ],
)
def test_metadata_that_could_not_be_read_are_not_written(path, about, rule):
    path.write_text("before", encoding="utf-8")
    with pytest.raises(BufgymError) as error:
        weights.save(path, made(3), about)
    assert rule in str(error.value)
    assert path.read_text(encoding="utf-8") == "before"


def test_weights_that_could_not_be_read_are_not_written(path):
    good = made(3)
    bad = replace(good, drop=replace(good.drop, bias=np.float32([np.nan])))
    with pytest.raises(BufgymError, match=r"tensor drop\.bias must hold finite numbers"):
        weights.save(path, bad, ABOUT)
    with pytest.raises(BufgymError, match=r"accept\.0\.weight = .*must be \[2, 3\]"):
        weights.save(path, replace(good, accept=made(4).accept), ABOUT)
    with pytest.raises(BufgymError, match="2 at most"):
        weights.save(path, made(3, 3, 3), ABOUT)
    with pytest.raises(BufgymError, match="1 to 256 hidden units"):
        weights.save(path, made(257), ABOUT)
    with pytest.raises(BufgymError, match="field = speed: unknown"):
        weights.save(path, made(3, fields=("speed", "service_ratio")), ABOUT)
    assert not path.exists()
    with pytest.raises(BufgymError, match="cannot be written"):
        weights.save(path / "no" / "folder", good, ABOUT)


# --- what is not read ------------------------------------------------------------------------------------------------


def test_a_missing_file_or_a_folder_is_refused(path):
    refused(path, "cannot be read", "No such file")
    refused(path.parent, "cannot be read")


def test_a_file_too_large_is_refused_and_not_read_to_its_end(path):
    with open(path, "wb") as file:
        file.truncate(1 << 40)
    refused(path, f"larger than the {weights.MAX_BYTES} bytes")


@pytest.mark.parametrize("keep", [0, 7, 8, 100, -1])
def test_a_truncated_file_is_refused(path, parts, keep):
    path.write_bytes(path.read_bytes()[:keep])
    refused(path, "no safetensors file, or a broken one")


@pytest.mark.parametrize("data", [b"hello", b"PK\x03\x04" * 20, b"\xff" * 64, (2).to_bytes(8, "little") + b"{]"])
def test_what_is_no_safetensors_is_refused(path, data):
    path.write_bytes(data)
    refused(path, "no safetensors file, or a broken one")


def test_a_safetensors_file_of_somebody_elses_is_refused(path):
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
    ("key", "value", "rule"),
    [
        ("format", 2, "format = 2: this bufgym reads format 1"),
        ("format", "1", "format = 1: this bufgym reads format 1"),
        ("name", 3, "name = 3: must be text"),
        ("name", "", "must be non-empty"),
        ("name", "\u001b[31mred", "must be non-empty"),
        ("name", "\ud800", "must be non-empty"),
        ("about", ["no", "text"], "must be one line of text"),
        ("bufgym", None, "must be text"),
        ("observation", "0" * 64, "trained on other observations than this bufgym's: train it again"),
        ("fields", "time_merged", "must be a list of at least one field"),
        ("fields", [], "must be a list of at least one field"),
        ("fields", ["time_merged", "speed"], "field = speed: unknown; known: occupied, rank"),
        ("fields", ["time_merged", ["service_ratio"]], "unknown; known: occupied, rank"),
        ("fields", ["service_ratio", "service_ratio"], "field = service_ratio: given more than once"),
        ("fields", ["service_ratio"], "must be [1] for 1 fields and hidden layers of [3]"),
    ],
)
def test_metadata_that_break_a_rule_are_refused(path, parts, key, value, rule):
    tensors, metadata = parts
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
    ("name", "tensor", "rule"),
    [
        ("drop.skip", None, "tensor drop.skip is missing"),
        ("accept.0.weight", None, "tensor accept.0.weight is missing"),
        ("drop.0.bias", None, "tensor drop.0.bias is missing"),
        ("accept.0.bias", None, "tensor accept.0.bias is missing"),
        ("drop.1.bias", np.zeros(3, np.float32), "tensor drop.1.weight is missing"),
        ("drop.2.bias", np.zeros(3, np.float32), "tensor drop.2.bias has no place in networks of 1 hidden layers"),
        ("critic", np.zeros(3, np.float32), "tensor critic has no place"),
        ("drop.skip", np.zeros(3, np.float32), "shape of tensor drop.skip = [3]: must be [2]"),
        ("drop.skip", np.zeros((2, 1), np.float32), "shape of tensor drop.skip = '[2, 1]': must be [2]"),
        ("drop.bias", np.zeros((), np.float32), "shape of tensor drop.bias = []: must be [1]"),
        ("drop.mix", np.zeros((1, 2), np.float32), "shape of tensor drop.mix = '[1, 2]': must be [1, 1]"),
        ("accept.mix", np.zeros((1, 1), np.float32), "tensor accept.mix has no place"),
        ("drop.0.bias", np.zeros(0, np.float32), "1 to 256 hidden units"),
        ("drop.0.bias", np.zeros(257, np.float32), "1 to 256 hidden units"),
        ("drop.0.bias", np.zeros((3, 1), np.float32), "1 to 256 hidden units"),
        ("drop.out", np.zeros(3, np.float64), "type of tensor drop.out = F64: must be F32"),
        ("drop.out", np.zeros(3, np.float16), "type of tensor drop.out = F16: must be F32"),
        ("drop.out", np.float32([0, np.nan, 0]), "tensor drop.out must hold finite numbers alone"),
        ("accept.out", np.float32([0, 0, -np.inf]), "tensor accept.out must hold finite numbers alone"),
    ],
)
def test_tensors_that_break_a_rule_are_refused(path, parts, name, tensor, rule):
    tensors, metadata = parts
    tensors = {**tensors, name: tensor} if tensor is not None else {k: v for k, v in tensors.items() if k != name}
    put(path, tensors, metadata)
    refused(path, rule)


def test_a_changed_number_is_refused(path, parts):
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
    # What was damaged is what the file tells of the weights, not they themselves.
    assert [x.tobytes() for x in (read.drop.flat(), read.accept.flat())] == FLAT
    assert read.fields == FIELDS
    learned.policy(metadata["name"], read).new_memory(1, 4)


def test_mixing_weights_come_back_as_they_were(path):
    mixed = replace(made(3), mix=np.float32([[-1.5]]))
    weights.save(path, mixed, ABOUT)
    again = weights.read(path)[0]
    assert again.mix.tolist() == [[-1.5]] and (again.parameters() == mixed.parameters()).all()


def test_a_second_scorer_comes_back_too_or_not_at_all(path):
    both = replace(made(3), still=replace(made(3), mix=np.float32([[2.5]])))
    weights.save(path, both, ABOUT)
    again, metadata = weights.read(path)
    assert again.mix is None and again.still.mix.tolist() == [[2.5]] and again.still.still is None
    assert (again.parameters() == both.parameters()).all()
    tensors = tensors_of(path.read_bytes())
    del tensors["still.drop.skip"]
    put(path, tensors, metadata)
    refused(path, "tensor still.drop.skip is missing")


@pytest.mark.parametrize(("widths", "others"), [((), (6,)), ((3,), ()), ((2,), (5, 4))])
def test_the_second_scorer_has_hidden_layers_of_its_own(path, widths, others):
    both = replace(made(*widths), still=made(*others, seed=1))
    weights.save(path, both, ABOUT)
    again = weights.read(path)[0]
    assert (len(again.drop.layers), len(again.still.drop.layers)) == (len(widths), len(others))
    assert (again.parameters() == both.parameters()).all()


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
    tensors, metadata = tensors_of(path.read_bytes()), weights.read(path)[1]
    tensors = {**tensors, name: tensor} if tensor is not None else {k: v for k, v in tensors.items() if k != name}
    put(path, tensors, metadata)
    refused(path, rule)


# --- the agents that come with bufgym --------------------------------------------------------------------------------


def test_shipped_agents_are_read_when_they_are_asked_for(path, parts, monkeypatch):
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    broken = path.with_name("broken.safetensors")
    broken.write_bytes(b"no weights")
    renamed = path.rename(path.with_name("renamed.safetensors"))
    weights.save(path, made(3), ABOUT)
    for file in (path, broken, renamed):
        registry.register_later(file.stem, lambda file=file: weights.load_shipped(file.stem, file))
    assert list(policies.names())[-3:] == ["small", "broken", "renamed"]
    small = policies.get("small")
    assert small.summary == ABOUT["about"]
    assert policies.get("small") is small
    with pytest.raises(BufgymError, match=r"broken\.safetensors: no safetensors file"):
        policies.get("broken")
    with pytest.raises(BufgymError, match=r"name = small: must be renamed, as the file"):
        policies.get("renamed")
    with pytest.raises(BufgymError, match="no parameter"):
        policies.get("small:w0=1")
    for name in ("small", "broken"):
        with pytest.raises(BufgymError, match="a built-in policy has this name"):
            policies.register(name)
    registry.register_later("afr", lambda: small)
    assert policies.get("afr").name == "afr"

"""Files of weights: what is written comes back bit for bit, and whatever cannot be read again is not written.

Whatever is wrong with a file is said in one line, and nothing of it is used.
"""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from cases import same
from refusal_cases import refuse
from safetensors.numpy import save as safetensors
from weight_cases import ABOUT, CHOICES, KINDS, QUEUE, made, parts_of, put, put_changed, random_weights, refused

from bufgym import __version__, policies
from bufgym.model import qoi
from bufgym.policies import learned, registry, weights
from bufgym.scenario import Interruption
from bufgym.sim import run
from bufgym.utils.errors import BufgymError


@pytest.fixture
def path(tmp_path):
    return tmp_path / "small.safetensors"


@pytest.mark.parametrize("before", [made(*widths) for widths in [(), (1,), (16, 4), (256,)]], ids=str)
def test_what_is_written_comes_back_bit_for_bit(path, before):
    assert weights.save(path, before, ABOUT) == path
    after, metadata = weights.read(path)
    assert type(after) is type(before)
    assert (after.fields, after.widths) == (before.fields, before.widths)
    assert after.parameters().tobytes() == before.parameters().tobytes()
    for name in before.NETWORKS:
        one, other = getattr(before, name), getattr(after, name)
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
    shapes = {name: list(tensor.shape) for name, tensor in parts_of(path)[0].items()}
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
    episodes, v = [Interruption(t_max=30).episode(T) for T in (5, 17, 30)], qoi.exponential(0.618)
    ours = run(policy, episodes, 4, v)
    assert same(ours, run(before.policy("same"), episodes, 4, v))
    assert not same(ours, run(made(4, seed=1).policy("other"), episodes, 4, v))


def test_reading_a_policy_needs_no_torch(path):
    for kind in KINDS:
        weights.save(path.with_name(f"{kind.__name__}.safetensors"), made(4, kind=kind), ABOUT)
    loads = "; ".join(f"policies.load({str(file)!r})" for file in path.parent.iterdir())
    program = f"import sys; from bufgym import policies; {loads}; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


@pytest.mark.parametrize(
    ("network", "command"), [("scheduler", "tune gap-priority"), ("guided", "tune gap-price"), ("ruled", "hindsight")]
)
def test_a_file_of_a_kind_that_is_gone_names_what_takes_its_place(path, network, command):
    weights.save(path, made(3), ABOUT)
    put(path, {f"{network}.weight": np.zeros((17, 9), np.float32)}, parts_of(path)[1])
    refused(path, "made by bufgym until 0.2: ", f": python train.py {command}")


def test_a_policy_for_one_queue_may_not_read_what_only_topics_have(path):
    refuse("field = waited: unknown", weights.save, path, random_weights(["waited"]), ABOUT)
    weights.save(path, random_weights(["service_ratio"]), ABOUT)
    assert isinstance(weights.read(path)[0], QUEUE)
    assert not policies.load(path).schedules


@pytest.mark.parametrize("widths", [(), (5,), (64, 64), (3, 2, 4)], ids=str)
def test_a_network_among_candidates_comes_back_bit_for_bit(path, widths):
    before = made(*widths, kind=CHOICES)
    weights.save(path, before, ABOUT)
    after, metadata = weights.read(path)
    assert isinstance(after, CHOICES)
    assert after.parameters().tobytes() == before.parameters().tobytes()
    names = ("candidates", "at_arrivals", "masks", "activation")
    assert [metadata[name] for name in names] == [getattr(after, name) for name in names] == [2, True, False, "tanh"]
    policy = policies.load(path)
    assert (policy.name, policy.ranked, policy.for_topics, policy.measures) == ("small", True, False, True)
    refuse("metadata masks: written by save itself", weights.save, path, before, {**ABOUT, "masks": True})


@pytest.mark.parametrize(
    ("about", "rule"),
    [
        ({"about": "No name."}, "name = (absent)"),
        ({"name": "two words"}, "name = 'two words': must be non-empty, without spaces"),
        ({"name": "ok", "about": "two\nlines"}, "must be one line of text"),
        ({"name": "ok", "sha256": "0"}, "sha256: written by save itself"),
        ({"name": "ok", "scores": float("nan")}, "metadata that JSON cannot hold"),
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
    for bad, rule in (
        (replace(good, drop=replace(good.drop, bias=np.float32([np.nan]))), r"tensor drop\.bias must hold"),
        (replace(good, accept=made(4).accept), r"accept\.0\.weight = .*must be \[2, 3\]"),
        (made(3, 3, 3), "2 at most"),
        (made(257), "1 to 256 hidden units"),
        (made(3, 3, 3, 3, kind=CHOICES), "3 at most"),
        (replace(made(3, kind=CHOICES), candidates=5), r"must be \[45, 3\] for 5 candidates"),
        (replace(made(3, kind=CHOICES), activation="elu"), "activation = elu: must be one of relu, tanh"),
        (made(3, fields=("speed", "service_ratio")), "field = speed: unknown"),
    ):
        refuse(rule, weights.save, path, bad, ABOUT)
    assert not path.exists()
    refuse("cannot be written", weights.save, path / "no" / "folder", good, ABOUT)


def test_shipped_agents_are_read_when_they_are_asked_for(path):
    weights.save(path, made(3), ABOUT)
    broken = path.with_name("broken.safetensors")
    broken.write_bytes(b"no weights")
    renamed = path.rename(path.with_name("renamed.safetensors"))
    weights.save(path, made(3), ABOUT)
    for file in (path, broken, renamed):
        registry.register_later(file.stem, lambda file=file: weights.load(file))
    assert list(policies.names())[-3:] == ["small", "broken", "renamed"]
    small = policies.get("small")
    assert small.summary == ABOUT["about"]
    assert policies.get("small") is small
    refuse(r"broken\.safetensors: no safetensors file", policies.get, "broken")
    refuse(r"policy 'renamed': its file names it 'small'", policies.get, "renamed")
    refuse("unknown parameter", policies.get, "small:w0=1")
    for name in ("small", "broken"):
        refuse("a built-in policy has this name", policies.register, name)
    registry.register_later("afr", lambda: small)
    assert policies.get("afr").name == "afr"
    registry.register_later("sent", lambda: replace(small, name="sent"), named_only=True)
    assert "sent" not in policies.names() and policies.get("sent").named_only


def test_fields_beside_the_tables_are_read_by_name(path):
    # What weights were trained on before these fields came is still what it was.
    assert weights.observation_hash(QUEUE, ("rank",)) == weights.observation_hash(QUEUE)
    fields = ("rank", "rate_short", "rate_long", "time_to_free")
    weights.save(path, random_weights(fields), ABOUT)
    read, metadata = weights.read(path)
    assert read.context == fields[1:]
    assert metadata["observation"] == weights.observation_hash(QUEUE, fields) != weights.observation_hash(QUEUE)
    assert policies.load(path).measures
    weights.save(path, random_weights(["rank"]), ABOUT)
    assert not policies.load(path).measures


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
    refused(path, "sha256", "fields, settings and tensors have another one")


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("{", "no JSON"),
        ('{"format": NaN}', "NaN: numbers must be finite"),
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
        (QUEUE, "name", 3, "name = 3: must be text"),
        (QUEUE, "name", "\u001b[31mred", "must be non-empty"),
        (QUEUE, "about", ["no", "text"], "must be one line of text"),
        (QUEUE, "bufgym", None, "must be text"),
        (QUEUE, "observation", "0" * 64, "trained on other observations than this bufgym's: train it again"),
        (QUEUE, "fields", "time_merged", "must be a list of at least one field"),
        (QUEUE, "fields", ["time_merged", ["service_ratio"]], "unknown; known: occupied, rank"),
        (QUEUE, "fields", ["service_ratio", "service_ratio"], "field = service_ratio: given more than once"),
        (QUEUE, "fields", ["service_ratio"], "must be [1] for 1 fields and hidden layers of [3]"),
        (CHOICES, "fields", ["candidate_place"], "fields = ['candidate_place']: must be candidate_place, candidate_n"),
        (CHOICES, "candidates", 65, "candidates = 65: must be a whole number from 1 to 64"),
        (CHOICES, "candidates", True, "candidates = True: must be a whole number"),
        (CHOICES, "candidates", 3, "must be [33, 3] for 3 candidates, at arrivals, and hidden layers of [3]"),
        (CHOICES, "at_arrivals", 1, "at_arrivals = 1: must be true or false"),
        (CHOICES, "at_arrivals", False, "must be [3, 3] for 2 candidates, at a full buffer, and hidden layers of [3]"),
        (CHOICES, "masks", None, "masks must be true or false"),
        (CHOICES, "masks", True, "sha256 = "),
        (CHOICES, "activation", "elu", "activation = elu: must be one of relu, tanh"),
        (CHOICES, "activation", "relu", "fields, settings and tensors have another one: the file was changed"),
        (CHOICES, "observation", weights.observation_hash(QUEUE), "trained on other observations than this bufgym's"),
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
    first, *others = learned.FIELDS
    monkeypatch.setattr(learned, "FIELDS", (replace(first, meaning=first.meaning + " now"), *others))
    refused(path, "trained on other observations")


def numbers(*shape, kind=np.float32):
    return np.zeros(shape, kind)


@pytest.mark.parametrize(
    ("kind", "name", "tensor", "rule"),
    [
        (QUEUE, "drop.skip", None, "tensor drop.skip is missing"),
        (QUEUE, "drop.0.bias", None, "tensor drop.0.bias is missing"),
        (QUEUE, "drop.1.bias", numbers(3), "tensor drop.1.weight is missing"),
        (QUEUE, "drop.2.bias", numbers(3), "tensor drop.2.bias has no place in networks of 1 hidden layers"),
        (QUEUE, "critic", numbers(3), "tensor critic has no place"),
        (QUEUE, "drop.skip", numbers(3), "shape of tensor drop.skip = [3]: must be [2]"),
        (QUEUE, "drop.bias", numbers(), "shape of tensor drop.bias = []: must be [1]"),
        (QUEUE, "drop.mix", numbers(1, 1), "tensor drop.mix has no place"),
        (QUEUE, "drop.0.bias", numbers(0), "1 to 256 hidden units"),
        (QUEUE, "drop.0.bias", numbers(257), "1 to 256 hidden units"),
        (QUEUE, "drop.out", numbers(3, kind=np.float64), "type of tensor drop.out = F64: must be F32"),
        (QUEUE, "drop.out", np.float32([0, np.nan, 0]), "tensor drop.out must hold finite numbers alone"),
        (QUEUE, "still.drop.out", numbers(3), "tensor still.drop.out has no place"),
        (CHOICES, "candidates.out.weight", None, "tensor candidates.out.weight is missing"),
        (CHOICES, "candidates.0.bias", None, "tensor candidates.0.bias is missing"),
        (CHOICES, "candidates.0.bias", numbers(257), "1 to 256 hidden units"),
        (CHOICES, "candidates.0.weight", numbers(26, 3), "must be [27, 3] for 2 candidates, at arrivals"),
        (CHOICES, "candidates.1.bias", numbers(3), "tensor candidates.1.weight is missing"),
        (CHOICES, "candidates.out.bias", np.float32([0, 0, np.inf, 0]), "must hold finite numbers alone"),
        (CHOICES, "critic", numbers(3), "tensor critic has no place"),
    ],
)
def test_tensors_that_break_a_rule_are_refused(path, kind, name, tensor, rule):
    weights.save(path, made(3, kind=kind), ABOUT)
    put_changed(path, name, tensor)
    refused(path, rule)

"""Learned policies decide as their weights say: against a slow twin, a fixed policy, and the network they came from."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cases import VALUES, cases, log, same
from gap_cases import fits
from hypothesis import given
from hypothesis import strategies as st
from refusal_cases import refuse
from weight_cases import network, score

from bufgym import cli, policies
from bufgym import scenario as scenarios
from bufgym.ground import files
from bufgym.model import observe, qoi
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.policies import weights as weights_file
from bufgym.policies.learned import NAMES, Network, Weights
from bufgym.policies.registry import Policy
from bufgym.scenario import Interruption
from bufgym.sim import run

kernels = pytest.mark.kernels
V = qoi.exponential(0.618)
SHIPPED = files.shipped("agents", "agents/pretrained", "*.safetensors")
SLOT_NAMES = [field.name for field in (*observe.SLOT_FIELDS, *observe.ON_BOARD_SLOT_FIELDS)]
CONTEXT_NAMES = [field.name for field in (*observe.CONTEXT_FIELDS, *observe.ON_BOARD_FIELDS)]


@st.composite
def weights(draw):
    """Any fields in any order; no, one or two hidden layers."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    on_board = draw(st.sets(st.sampled_from([field.name for field in observe.ON_BOARD_SLOT_FIELDS]), min_size=1))
    others = draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=6, unique=True))
    fields = tuple(dict.fromkeys([*others, *(sorted(on_board) if draw(st.booleans()) else [])]))
    widths = draw(st.sampled_from([(), (1,), (3,), (4, 2), (2, 5)]))
    return Weights(fields, network(rng, len(fields), *widths), network(rng, len(fields), *widths))


def twin(made):
    """A policy that decides by these weights: every candidate is scored, the best is searched for afterwards."""

    def on_arrival(buffer, arrival, memory):
        s, L = len(buffer.slots), buffer.capacity
        slots, context = np.zeros((len(SLOT_NAMES), L + 1)), np.zeros(len(CONTEXT_NAMES))
        observe.observe(buffer, arrival, slots[: len(observe.SLOT_FIELDS)], context[: len(observe.CONTEXT_FIELDS)])
        observe.observe_on_board_slots(buffer, arrival, slots[len(observe.SLOT_FIELDS) :])
        observe.observe_on_board(buffer, arrival, context[len(observe.CONTEXT_FIELDS) :])

        def features(k):
            seen = dict(zip(SLOT_NAMES, slots[:, k], strict=True)) | dict(zip(CONTEXT_NAMES, context, strict=True))
            return [float(seen[name]) for name in made.fields]

        def drop_score(k):
            return score(made.drop, features(k))

        choices, own = [(drop_score(k), k) for k in range(s)], drop_score(L)
        freed = sum(int(buffer.slots[k]["size_bytes"]) for value, k in choices if value >= own)
        excess = buffer.backlog_bytes + int(arrival["size_bytes"]) - buffer.max_bytes
        if buffer.evictions == 0 and freed < excess:
            choices = []  # the newcomer would not fit if all went that score no less
        if buffer.evictions == 0:
            choices.append((own, REJECT))
        best = max(value for value, _ in choices)
        first = next(decision for value, decision in choices if value == best)
        if fits(buffer, arrival) and score(made.accept, features(L)) >= best:
            return ACCEPT
        return first

    return Policy("twin", on_arrival)


@kernels
@given(cases(), VALUES, weights(), st.integers(1, 20))
def test_decides_as_its_twin_compiled_and_not(case, v, made, capacity):
    case = replace(case, capacity=capacity)
    policy = made.policy("random-weights")
    ours, again, memory = case.run(policy, v), case.senders(v), policy.new_memory(1, capacity)
    memory[:] = np.nan  # what the scratch held before does not matter, nor what the episode left
    for _ in range(2):
        again.load(0, case.episode)
        again.run(policy, memory)
        assert same(ours, again)
    assert same(ours, case.run(twin(made), v))
    assert same(ours, case.run(replace(policy, compile=False), v))
    if case.episode.first_decision == 0 and case.episode.last_decision > len(case.twin_messages):
        assert int(ours.batch.senders["invalid"][0]) == 0


@kernels
def test_the_twin_counts_as_one_does_by_hand():
    # h = relu(2 * 3 - 1, -4 * 3 + 1) = (5, 0); score = 10 * 5 + 100 * 0 + 7 * 3 + 0.5
    weight, bias = np.float32([[2, -4]]), np.float32([-1, 1])
    net = Network(np.float32([7]), np.float32([0.5]), ((weight, bias),), np.float32([10, 100]))
    assert score(net, [3.0]) == 71.5
    # A second layer: relu(5 * 1 + 0 * 9 + 2) = 7; score = -3 * 7 + 7 * 3 + 0.5
    second = (np.float32([[1], [9]]), np.float32([2]))
    assert score(replace(net, layers=(*net.layers, second), out=np.float32([-3])), [3.0]) == 0.5


def start(fields, seen):
    """No hidden layer: the smallest value of one field goes, and whatever finds room is accepted."""
    inputs, nothing = np.zeros(len(fields), np.float32), np.zeros(0, np.float32)
    drop = Network(inputs.copy(), np.float32([0]), (), nothing)
    drop.skip[fields.index(seen)] = -10
    return Weights(fields, drop, Network(inputs, np.float32([5]), (), nothing)).policy("linear")


@kernels
def test_bytes_that_fit_exactly_are_room():
    """With B for three messages and L = 8, three are queued; then one goes for each that comes."""
    episode = Interruption(t_max=10).episode(10)
    (size,) = set(episode.arrivals["size_bytes"].tolist())
    senders = run(start(("time_merged",), "time_merged"), [episode], 8, V, max_bytes=3 * size)
    (sender,) = senders.batch.senders
    assert (sender["peak_backlog_bytes"], sender["invalid"]) == (3 * size, 0)
    assert sender["evicted"] > 0
    assert len(log(senders)["dropped_us"]) == 10 - 3


def exported(*words):
    """``bufgym export`` with these words."""
    cli.app()(["export", *map(str, words)])


CAPACITY, WIDTH = 5, 8
WORLD = replace(scenarios.get("lte"), duration_s=10.0, size_bytes=500_000)


def untrained(tmp_path, network="slots"):
    """A model with random weights, saved as training leaves it; skips where training's extra is not installed."""
    for extra in ("sb3_contrib", "tqdm", "tensorboard"):
        pytest.importorskip(extra, reason="the extra [train] is not installed")
    import torch
    from sb3_contrib import MaskablePPO

    from bufgym.sb3 import make_vec_env
    from bufgym.sb3.networks import policy_of

    env = make_vec_env("bufgym/Uplink-v0", 2, scenario=WORLD, capacity=CAPACITY, decide_at="arrival")
    policy, its_settings = policy_of(network, WIDTH)
    model = MaskablePPO(policy, env, n_steps=8, batch_size=16, policy_kwargs=its_settings, device="cpu")
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    model.save(tmp_path / "model.zip")
    return model


def test_export_takes_over_what_the_run_noted(tmp_path):
    untrained(tmp_path)
    model, notes, out = tmp_path / "model.zip", tmp_path / "notes.json", tmp_path / "one.safetensors"
    exported(model, out, "--name", "alone")
    assert "training" not in weights_file.read(out)[1]
    noted = {"training": "python train.py --capacity 5", "seeds": [3], "scores": {"qoi": 9.5, "drop-oldest": 7.25}}
    notes.write_text(json.dumps(noted), encoding="utf-8")
    exported(model, out, "--name", "one", "--about", "Random.")
    weights, metadata = weights_file.read(out)
    assert {key: metadata[key] for key in noted} == noted
    policy = policies.load(out)
    assert (policy.name, policy.summary) == ("one", "Random.")
    assert weights.widths == (8, 8) and set(weights.fields) == {field.name for field in observe.FIELDS}
    notes.write_text("{", encoding="utf-8")
    refuse(r"notes\.json: cannot be read", exported, model, tmp_path / "two.safetensors", "--name", "two")


def test_what_is_no_slot_scorer_is_not_exported(tmp_path):
    untrained(tmp_path, network="plain")
    (tmp_path / "text.zip").write_text("hello", encoding="utf-8")
    for name, says in (
        ("model.zip", "only an agent that scores slots"),
        ("other.zip", "no such file"),
        ("text.zip", r"text\.zip: no model of stable-baselines3"),
    ):
        refuse(says, exported, tmp_path / name, tmp_path / "out.safetensors", "--name", "none")
    assert not (tmp_path / "out.safetensors").exists()

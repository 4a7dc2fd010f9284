"""Models trained among ordered candidates, as policies and as files: they decide as in the environment."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from needs import needs

pytest.importorskip("sb3_contrib", reason=needs("extras", "sb3_contrib"))

import torch
from refusal_cases import refuse
from sb3_contrib import QRDQN, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

import bufgym
from bufgym import cli, policies
from bufgym.envs import SenderVectorEnv
from bufgym.policies import weights
from bufgym.policies.candidate_network import CandidateWeights
from bufgym.sb3 import as_policy, make_vec_env
from bufgym.sb3.export import export, weights_of
from bufgym.scenario import get as scenario_of
from bufgym.scenario.numbered import draw
from bufgym.sim import run

SCENARIO = replace(scenario_of("lte"), duration_s=2.0, size_bytes=300_000)
UNEQUAL = replace(SCENARIO, size_cv=0.7)
WORLD: dict[str, Any] = {"duration_s": 2.0, "size_bytes": 300_000}


def model_of(algorithm: Any, policy: str = "MlpPolicy", seed: int = 4, env: Any = None, **options: Any) -> Any:
    """A model with large random weights: its decisions vary. ``env`` has options of the environment.

    At arrivals it is inclined to accept, as a queue that stays empty offers no choice.
    """
    if algorithm not in (DQN, QRDQN):
        options = {"n_steps": 8, **({} if algorithm is A2C else {"batch_size": 16}), **options}
    envs = make_vec_env("bufgym/Uplink-v1", 2, seed=0, **{**WORLD, **(env or {})})
    model = algorithm(policy, envs, seed=1, device="cpu", **options)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.copy_(2 * torch.randn(parameter.shape, generator=generator) / parameter.shape[-1] ** 0.5)
        if "arrival" in (env or {}).values():
            net = model.policy
            last = net.q_net.q_net[-1] if algorithm is DQN else getattr(net, "action_net", None)
            last = last if last is not None else net.quantile_net.quantile_net[-1]
            last.bias.view(-1, int(model.action_space.n))[:, 0] += 4.0 if algorithm in (PPO, A2C, MaskablePPO) else 12.0
    return model


def in_environment(model: Any, scenario: Any, episodes: Any, L: int, **options: Any) -> Any:
    """The senders after the model has played these episodes in the environment, without a policy."""
    envs = SenderVectorEnv(len(episodes), scenario, L, **options)
    envs.reset(options={"episodes": episodes})
    sub_envs = envs.sub_envs
    while not sub_envs.output.terminated.all():
        masks = {"action_masks": sub_envs.output.action_mask} if isinstance(model, MaskablePPO) else {}
        sub_envs.step(sub_envs.actions(model.predict(sub_envs.observation(), deterministic=True, **masks)[0]))
    return sub_envs.senders


def assert_same(
    policy: Any, model: Any, L: int = 3, scenario: Any = SCENARIO, B: int | None = None, **options: Any
) -> None:
    """Each message meets the same fate at the same time, and the decisions are no single one."""
    episodes = [draw(scenario, seed) for seed in range(3)]
    ours = run(policy, episodes, L, scenario.value, max_bytes=B)
    theirs = in_environment(model, scenario, episodes, L, max_bytes=B, **options)
    for i, episode in enumerate(episodes):
        for name in ("dropped_us", "dequeued_us"):
            logs = (np.asarray(senders.batch.log[name][i])[: len(episode.arrivals)] for senders in (ours, theirs))
            assert np.array_equal(*logs)
    evicted, rejected = (ours.batch.senders[name].sum() for name in ("evicted", "rejected"))
    assert evicted > 0 and rejected > 0


@pytest.mark.parametrize("L", [3, 8, 16])
@pytest.mark.parametrize("decide_at", ["overflow", "arrival"])
@pytest.mark.parametrize("algorithm", [PPO, A2C, MaskablePPO, DQN])
def test_a_model_decides_as_in_the_environment_for_every_L(algorithm: Any, decide_at: str, L: int) -> None:
    model = model_of(algorithm, env={"decide_at": decide_at, "capacity": 8})
    policy = as_policy(model, "mine")
    assert policy.compile
    assert_same(policy, model, L, decide_at=decide_at)


@pytest.mark.parametrize("decide_at", ["overflow", "arrival"])
def test_it_does_so_with_unequal_sizes_and_a_limit_of_bytes(decide_at: str) -> None:
    """Then one eviction may not be enough, and the policy is asked again, without the newcomer as a candidate."""
    model = model_of(MaskablePPO, env={"decide_at": decide_at, "candidates": 4})
    policy = as_policy(model)
    assert_same(policy, model, 8, UNEQUAL, 1_200_000, decide_at=decide_at, candidates=4)


def all_ways(model: Any, folder: Path) -> list[Any]:
    """The policy of a model as it is, of its zip, and of its file of weights."""
    model.save(folder / "mine.zip")
    cli.app()(["export", str(folder / "mine.zip"), str(folder / "mine.safetensors"), "--name", "mine"])
    return [as_policy(model), as_policy(folder / "mine.zip"), policies.load(folder / "mine.safetensors")]


def test_an_exported_model_is_one_policy_like_any_other(tmp_path: Path) -> None:
    model = model_of(MaskablePPO, env={"decide_at": "arrival"})
    for policy in all_ways(model, tmp_path):
        assert_same(policy, model, decide_at="arrival")
    assert (policy.name, policy.compile, policy.ranked) == ("mine", True, True)
    found, notes = weights.read(tmp_path / "mine.safetensors")
    assert len(notes["regret"]) > 0
    assert (notes["candidates"], notes["at_arrivals"], notes["masks"], notes["activation"]) == (2, True, True, "tanh")
    assert isinstance(found, CandidateWeights)
    assert found.parameters().tobytes() == weights_of(model).parameters().tobytes()


@pytest.mark.nightly
def test_a_model_that_has_learned_decides_so_too(tmp_path: Path) -> None:
    """2,000 steps by stable-baselines3's defaults, but for rollouts of 64 steps."""
    model: Any = PPO("MlpPolicy", make_vec_env("bufgym/Uplink-v1", 8, seed=0, **WORLD), n_steps=64, device="cpu")
    model.learn(2_000)
    for policy in all_ways(model, tmp_path):
        episodes = [draw(SCENARIO, seed) for seed in range(3)]
        ours = run(policy, episodes, 8, SCENARIO.value)
        theirs = in_environment(model, SCENARIO, episodes, 8)
        assert np.array_equal(ours.batch.log["dropped_us"], theirs.batch.log["dropped_us"])


@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU])
@pytest.mark.parametrize("widths", [[], [5], [7, 3, 4]], ids=str)
def test_any_perceptron_of_up_to_three_layers_is_compiled(widths: list[int], activation: Any) -> None:
    model = model_of(PPO, policy_kwargs={"net_arch": widths, "activation_fn": activation})
    found = weights_of(model)
    assert isinstance(found, CandidateWeights) and [len(bias) for _, bias in found.layers] == [*widths, 3]
    assert_same(as_policy(model), model)


@pytest.mark.parametrize(
    ("algorithm", "policy", "options", "env"),
    [
        (PPO, "MlpPolicy", {"policy_kwargs": {"net_arch": [4, 4, 4, 4]}}, {}),
        (PPO, "MlpPolicy", {"policy_kwargs": {"activation_fn": nn.ELU}}, {"decide_at": "overflow"}),
        (MaskablePPO, "MlpPolicy", {"policy_kwargs": {"net_arch": [257]}}, {}),
        (QRDQN, "MlpPolicy", {}, {}),
        (PPO, "MlpPolicy", {}, {"fields": ["rate_short"]}),
        (DQN, "MlpPolicy", {}, {"fields": ["time_to_free", "rate_short"]}),
        (PPO, "MultiInputPolicy", {}, {"observation": "dict"}),
        (MaskablePPO, "MultiInputPolicy", {}, {"observation": "dict", "fields": ["rate_short", "time_to_free"]}),
    ],
)
def test_other_networks_run_in_torch_for_every_L(algorithm: Any, policy: str, options: Any, env: Any) -> None:
    env = {"decide_at": "arrival", **env}
    model = model_of(algorithm, policy, env=env, **options)
    ours = as_policy(model, "slow")
    assert not ours.compile
    for L in (3, 8):
        assert_same(ours, model, L, **env)
    refuse('only networks of PPO, A2C, MaskablePPO or DQN with "MlpPolicy" and at most 3 hidden', weights_of, model)


@pytest.mark.parametrize(("form", "network"), [("dict", "MultiInputPolicy"), ("flat", "MlpPolicy")])
def test_a_field_of_each_slot_ties_a_model_to_its_L(form: str, network: str) -> None:
    env = {"observation": form, "fields": ["rate_short", "index_merged"], "capacity": 3}
    model = model_of(PPO, network, env=env)
    policy = as_policy(model, "tied")
    assert_same(policy, model, 3, observation=form, fields=env["fields"])
    refuse(
        "policy tied: trained for L = 3, not for L = 5, as it observes",
        run,
        policy,
        [draw(SCENARIO, 0)],
        5,
        SCENARIO.value,
    )


def test_names_of_a_flat_models_fields_are_in_its_file(tmp_path: Path) -> None:
    """27 numbers of two candidates, the head and the queue, then the two named ones in the order they were named."""
    fields = ["time_to_free", "rate_short"]
    for order in (fields, fields[::-1]):
        model = model_of(PPO, env={"fields": order, "decide_at": "arrival"})
        assert model.observation_space.shape == (29,) and [*model.observation_space.fields][-2:] == order
        model.save(tmp_path / "named.zip")
        assert_same(as_policy(tmp_path / "named.zip"), model, 8, fields=order, decide_at="arrival")


def test_what_cannot_be_a_policy_or_a_file_is_refused(tmp_path: Path) -> None:
    normalized: Any = PPO("MlpPolicy", VecNormalize(make_vec_env("bufgym/Uplink-v1", 2, **WORLD)), device="cpu")
    for reads in (as_policy, weights_of):
        refuse("observes through VecNormalize .*train with norm_obs=False", reads, normalized)
    rewards: Any = VecNormalize(make_vec_env("bufgym/Uplink-v1", 2, **WORLD), norm_obs=False)
    assert as_policy(PPO("MlpPolicy", rewards, device="cpu")).compile
    nameless: Any = model_of(PPO, env={"fields": ["rate_short"]})
    del nameless.observation_space.fields  # as of a wrapper that makes a space of its own
    refuse(
        r"observes 28 numbers: must be the 29 of .* for L = 1; of candidates 21 or 27, and further", as_policy, nameless
    )
    recurrent: Any = RecurrentPPO("MlpLstmPolicy", make_vec_env("bufgym/Uplink-v1", 2, **WORLD), device="cpu")
    refuse("recurrent", as_policy, recurrent)
    refuse("only networks of PPO", weights_of, recurrent)
    recurrent.save(tmp_path / "lstm.zip")
    refuse("only networks of PPO", export, tmp_path / "lstm.zip", tmp_path / "out.safetensors", name="lstm")
    assert not (tmp_path / "out.safetensors").exists()


def test_weights_are_those_of_the_model() -> None:
    """Row i of a layer's weights is input i; torch keeps the transpose."""
    model = model_of(DQN, policy_kwargs={"net_arch": [6]})
    found = weights_of(model)
    assert isinstance(found, CandidateWeights)
    assert (found.candidates, found.at_arrivals, found.masks, found.activation) == (2, False, False, "relu")
    (first, bias), (last, _) = found.layers
    torch_first, _, torch_last = model.q_net.q_net
    assert np.array_equal(first.T, torch_first.weight.detach()) and np.array_equal(last.T, torch_last.weight.detach())
    assert np.array_equal(bias, torch_first.bias.detach())


def test_a_model_in_torch_runs_on_a_suite_and_its_folder_knows_its_numbers(tmp_path: Path) -> None:
    lab = bufgym.suite("lab-v1", SCENARIO, capacity=3, seeds=1)
    models = [model_of(PPO, seed=seed, env={"fields": ["rate_short"], "capacity": 3}) for seed in (4, 5)]
    first, other = (as_policy(model, "mine") for model in models)
    done = bufgym.compare(first, lab, out=tmp_path / "out", progress=False)
    again = bufgym.compare(as_policy(models[0], "mine"), lab, out=tmp_path / "out", progress=False)
    assert repr(again.rows) == repr(done.rows)
    refuse("made_of is .*never mixed", bufgym.compare, other, lab, out=tmp_path / "out", progress=False)

"""What stable-baselines3 may rely on: its own check of the single environment, and the contract of its VecEnv."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from needs import needs

pytest.importorskip("sb3_contrib", reason=needs("extras", "sb3_contrib"))

import torch
from refusal_cases import refuse, refused
from sb3_contrib import MaskablePPO, RecurrentPPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common import env_util
from stable_baselines3.common.monitor import Monitor, get_monitor_files

import bufgym
from bufgym import cli, policies
from bufgym.envs import SenderVectorEnv
from bufgym.model.observe import FIELDS as FIELDS_OF_ALL
from bufgym.policies import weights
from bufgym.sb3 import GymVecEnv, SlotPolicy, as_policy, make_vec_env
from bufgym.scenario import Interruption
from bufgym.scenario import get as scenario_of
from bufgym.scenario.numbered import draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.utils.errors import BufgymError

SMALL: dict[str, dict[str, Any]] = {
    "bufgym/Interruption-v1": {"capacity": 3, "t_max": 20},
    "bufgym/Uplink-v1": {"capacity": 3, "duration_s": 1.0, "size_bytes": 1_000_000},
    "bufgym/Topics-v0": {"capacity": 3, "duration_s": 0.1},
    "bufgym/Suite-v1": {"capacity": 3, "suite": "interruption-v1"},
}
L = 3


def same(a: Any, b: Any) -> bool:
    """Whether two observations, arrays or dicts of them, are equal bit for bit."""
    return (
        a.keys() == b.keys() and all(map(same, a.values(), b.values())) if isinstance(a, dict) else bool((a == b).all())
    )


@pytest.mark.parametrize("id", bufgym.ENVIRONMENTS)
def test_rows_are_those_of_the_native_batch_and_their_ends_are_told(id: str) -> None:
    """tests/envs shows that the native batch's rows are single environments."""
    n, rng = 3, np.random.default_rng(0)
    envs = make_vec_env(id, n, seed=7, reward="retained", **SMALL[id])
    native: Any = gym.make_vec(id, n, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP, reward="retained", **SMALL[id])
    observation, (last, info) = envs.reset(), native.reset(seed=7)
    sums, lengths, ends = np.zeros(n), np.zeros(n, int), 0
    for _ in range(60):
        assert same(observation, last)
        masks = get_action_masks(envs)
        assert np.array_equal(masks, info["action_mask"])
        actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])
        observation, rewards, dones, infos = envs.step(actions)
        last, reward, terminated, truncated, info = native.step(actions)
        assert np.array_equal(rewards, np.float32(reward)) and np.array_equal(dones, terminated | truncated)
        sums, lengths = sums + reward, lengths + 1
        for i, (own, done) in enumerate(zip(infos, dones, strict=True)):
            if not done:
                assert own == {}
                continue
            final = info["final_obs"][i]
            assert same(own["terminal_observation"], final)
            assert own["TimeLimit.truncated"] is False
            assert (own["episode"]["r"], own["episode"]["l"]) == (pytest.approx(sums[i]), lengths[i])
            assert all(own[name] == info["final_info"][name][i] for name in ("qoi", "arrived", "delivered", "invalid"))
            if id != "bufgym/Topics-v0":  # each topic received adds its weight there
                assert own["qoi"] == pytest.approx(1 + sums[i])
            sums[i], lengths[i], ends = 0.0, 0, ends + 1
    assert ends >= n


def test_a_time_limit_truncates() -> None:
    envs = make_vec_env(
        "bufgym/Uplink-v1", 2, seed=0, max_episode_steps=5, **SMALL["bufgym/Uplink-v1"], actions="slots"
    )
    envs.reset()
    for step in range(1, 11):
        _, _, dones, infos = envs.step(np.full(2, L))  # reject everything
        assert dones.tolist() == [step % 5 == 0] * 2
        if dones[0]:
            assert infos[0]["TimeLimit.truncated"] is True and infos[0]["episode"]["l"] == 5
            assert infos[0]["terminal_observation"]["rank"].shape == (L + 1,)


def test_masks_and_attributes() -> None:
    envs = make_vec_env("bufgym/Interruption-v1", 5, **SMALL["bufgym/Interruption-v1"], actions="slots")
    envs.reset()
    masks = get_action_masks(envs)
    assert is_masking_supported(envs) and masks.dtype == np.bool_
    # An empty buffer: nothing to evict, the newcomer may be rejected or accepted.
    assert masks.tolist() == [[False] * L + [True, True]] * 5
    assert (len(envs.env_method("action_masks", indices=[1, 3])), len(envs.get_attr("action_masks"))) == (2, 5)
    assert envs.get_attr("action_space", 0) == [gym.spaces.Discrete(L + 2)]
    assert envs.get_attr("render_mode") == [None] * 5 and not envs.has_attr("no_such_thing")
    envs.set_attr("note", "kept")
    assert envs.get_attr("note", [0, 4]) == ["kept", "kept"]
    refuse("share it", envs.set_attr, "note", "lost", indices=[1])
    assert envs.env_is_wrapped(Monitor) == [True] * 5
    assert envs.env_is_wrapped(gym.wrappers.TimeLimit) == [False] * 5
    envs.close()


def test_seeds_and_options_hold_for_one_reset() -> None:
    envs = make_vec_env("bufgym/Interruption-v1", 2, **SMALL["bufgym/Interruption-v1"], actions="slots")
    assert envs.seed(3) == [3, 4]

    def lengths() -> list[int]:
        found = [0, 0]
        envs.reset()
        while not all(found):
            _, _, dones, infos = envs.step(np.full(2, L))
            for i in np.flatnonzero(dones):
                found[i] = found[i] or infos[i]["arrived"]
        return found

    first, second = lengths(), lengths()
    envs.seed(3)
    assert (lengths(), lengths()) == (first, second)
    scenario = envs.get_attr("sub_envs")[0].scenario
    envs.set_options({"episodes": [scenario.episode(4), scenario.episode(9)]})
    assert lengths() == [6, 11]  # T and the two messages around the interruption
    refuse("not a list", envs.set_options, [{}, {}])


def test_a_monitor_file(tmp_path: Path) -> None:
    """T = 20 always: each episode has 20 decisions, and what it delivers is written to the folder as Monitor does."""
    given: dict[str, Any] = {"t_max": 20, "law": "fixed", "capacity": L, "seed": 5, "reward": "retained"}
    envs = make_vec_env("bufgym/Interruption-v1", 3, monitor_dir=str(tmp_path), **given, actions="slots")
    assert envs.num_envs == 3
    envs.reset()
    for _ in range(40):
        *_, infos = envs.step(np.full(3, L + 1))
    assert infos[0]["episode"]["r"] == pytest.approx(infos[0]["qoi"] - 1)
    assert infos[0]["dropped"] == 20 - L
    envs.close()
    (file,) = get_monitor_files(str(tmp_path))  # which ``load_results`` reads with pandas
    assert Path(file).name == "0.monitor.csv" and len([*tmp_path.iterdir()]) == 1
    header, *lines = Path(file).read_text().splitlines()
    assert json.loads(header[1:])["env_id"] == "bufgym/Interruption-v1"
    results = list(csv.DictReader(lines))
    assert [row["l"] for row in results] == ["20"] * 6
    assert [float(row["r"]) for row in results] == pytest.approx([infos[0]["episode"]["r"]] * 6, abs=1e-6)


test_what_a_native_batch_cannot_do_is_an_error = refused(
    (lambda: make_vec_env("bufgym/Interruption-v1", num_envs=2, actions="slots"), "stable-baselines3 calls it n_envs"),
    (
        lambda: make_vec_env("bufgym/Uplink-v1", env_kwargs={"capacity": 8}, actions="slots"),
        "'env_kwargs': settings go by",
        TypeError,
    ),
    (
        lambda: make_vec_env("bufgym/Uplink-v1", vec_env_cls=GymVecEnv, actions="slots"),
        "'vec_env_cls': stable_baselines3.*make_",
        TypeError,
    ),
    *((lambda id=id: make_vec_env(id), "has no native batch") for id in ("CartPole-v1", Monitor)),
    (lambda: GymVecEnv(gym.make_vec("bufgym/Uplink-v1", 2, actions="slots")), "SAME_STEP"),
)


WORLD: dict[str, Any] = {"capacity": L, "duration_s": 2.0, "size_bytes": 1_000_000}
FIELDS = ("rank", "motion_merged", "occupied", "occupancy")


def untrained(algorithm: Any, policy: Any, env: Any = None, seed: int = 4, **options: Any) -> Any:
    """A model with large random weights: its decisions vary."""
    if algorithm is not DQN:
        options = {"n_steps": 8, **({} if algorithm is A2C else {"batch_size": 16}), **options}
    env = env or make_vec_env("bufgym/Uplink-v1", 2, seed=0, decide_at="arrival", **WORLD, actions="slots")
    model = algorithm(policy, env, seed=1, device="cpu", **options)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return model


def flat_env() -> Any:
    return env_util.make_vec_env(
        lambda: gym.wrappers.FlattenObservation(gym.make("bufgym/Uplink-v1", **WORLD, actions="slots")), 2
    )


SCENARIO = replace(scenario_of("lte"), duration_s=2.0, size_bytes=1_000_000)
EPISODES = [draw(SCENARIO, seed) for seed in range(4)]


def reached(policy: Any) -> list[Any]:
    """What a policy reaches in ``EPISODES``; no decision is invalid where it asks for masks."""
    senders = run(policy, EPISODES, L, SCENARIO.value)
    ours = [outcome(senders, i) for i in range(4)]
    assert any(result.delivered and result.dropped for result in ours)
    return ours


def reached_in_env(model: Any, form: str, fields: Any = None, acts: str = "slots") -> list[Any]:
    envs = SenderVectorEnv(4, SCENARIO, L, decide_at="arrival", actions=acts, fields=fields, observation=form)
    envs.reset(options={"episodes": EPISODES})
    sub_envs = envs.sub_envs
    while not sub_envs.output.terminated.all():
        observation: Any = sub_envs.observation()
        masks = {"action_masks": sub_envs.output.action_mask} if isinstance(model, MaskablePPO) else {}
        sub_envs.step(sub_envs.actions(model.predict(observation, deterministic=True, **masks)[0]))
    return [outcome(sub_envs.senders, i) for i in range(4)]


@pytest.mark.parametrize("network", ["MultiInputPolicy", "MlpPolicy"])
@pytest.mark.parametrize(("algorithm", "saved"), [(PPO, False), (MaskablePPO, True), (DQN, True), (A2C, False)])
def test_any_model_decides_as_in_the_environment(algorithm: Any, saved: bool, network: str, tmp_path: Path) -> None:
    flat = network == "MlpPolicy"
    model = untrained(algorithm, network, flat_env() if flat else None)
    if saved:
        model.save(tmp_path / "mine.zip")
    policy = as_policy(tmp_path / "mine.zip" if saved else model)
    assert policy.name == ("mine" if saved else algorithm.__name__.lower())
    ours = reached(policy)
    assert repr(ours) == repr(reached_in_env(model, "flat" if flat else "dict"))  # NaN is NaN
    assert algorithm is not MaskablePPO or not any(result.invalid for result in ours)


def test_a_slot_network_serves_every_L_and_a_few_fields_are_enough(tmp_path: Path) -> None:
    env = make_vec_env("bufgym/Uplink-v1", 2, seed=0, fields=FIELDS, **WORLD, actions="slots")
    model = untrained(MaskablePPO, SlotPolicy, env, 6, policy_kwargs={"width": 8})
    model.save(tmp_path / "slots.zip")
    for policy in (as_policy(model, "slots"), as_policy(tmp_path / "slots.zip")):
        assert policy.name == "slots" and policy.compile
        assert repr(reached(policy)) == repr(reached_in_env(model, "dict", FIELDS))
        assert (run(policy, EPISODES, 20, SCENARIO.value).batch.senders["invalid"] == 0).all()


def test_export_takes_over_what_the_run_noted(tmp_path: Path) -> None:
    untrained(MaskablePPO, SlotPolicy, policy_kwargs={"width": 8}).save(tmp_path / "model.zip")
    model, notes, out = tmp_path / "model.zip", tmp_path / "notes.json", tmp_path / "one.safetensors"
    exported(model, out, "--name", "alone")
    assert "training" not in weights.read(out)[1]
    noted = {"training": "python train.py --capacity 5", "seeds": [3], "scores": {"qoi": 9.5, "drop-oldest": 7.25}}
    notes.write_text(json.dumps(noted), encoding="utf-8")
    exported(model, out, "--name", "one", "--about", "Random.")
    agent, metadata = weights.read(out)
    assert {key: metadata[key] for key in noted} == noted
    policy = policies.load(out)
    assert (policy.name, policy.summary) == ("one", "Random.")
    assert agent.widths == (8, 8) and set(agent.fields) == {field.name for field in FIELDS_OF_ALL}
    notes.write_text("{", encoding="utf-8")
    refuse(r"notes\.json: cannot be read", exported, model, tmp_path / "two.safetensors", "--name", "two")
    untrained(MaskablePPO, "MultiInputPolicy").save(tmp_path / "plain.zip")
    (tmp_path / "text.zip").write_text("hello", encoding="utf-8")
    for name, says in (
        ("plain.zip", "only an agent that chooses among candidates, observed flat, or scores slots"),
        ("other.zip", "no such file"),
        ("text.zip", r"text\.zip: no model of stable-baselines3"),
    ):
        refuse(says, exported, tmp_path / name, tmp_path / "out.safetensors", "--name", "none")
    assert not (tmp_path / "out.safetensors").exists()


def exported(*words: object) -> None:
    """``bufgym export`` with these words."""
    cli.app()(["export", *map(str, words)])


@pytest.mark.parametrize(("form", "network"), [("dict", "MultiInputPolicy"), ("flat", "MlpPolicy")])
def test_an_agent_for_topics_is_a_scheduler(form: str, network: str) -> None:
    """It drops and sends as in the environment, up to the last message: only there may a policy not hold."""
    client = scenario_of("topics", duration_s=0.5)
    env = make_vec_env("bufgym/Topics-v0", 2, seed=0, capacity=6, duration_s=0.5, observation=form)
    model = untrained(MaskablePPO, network, env)
    policy = as_policy(model, "scheduler")
    assert policy.for_topics and policy.schedules
    episode = draw(client, 0)
    envs = SenderVectorEnv(1, client, 6, observation=form)
    envs.reset(options={"episodes": [episode]})
    sub_envs = envs.sub_envs
    while not sub_envs.output.terminated.all():
        action, _ = model.predict(sub_envs.observation(), deterministic=True, action_masks=sub_envs.output.action_mask)
        sub_envs.step(np.asarray(action, np.int64))
    senders = run(policy, [episode], 6, client.value, topics=client.topics)
    for name in ("rejected", "evicted", "transmitted"):
        assert senders.batch.senders[name][0] == sub_envs.senders.batch.senders[name][0]
    assert np.array_equal(senders.batch.log["dropped_us"][0], sub_envs.senders.batch.log["dropped_us"][0])


def test_models_that_cannot_be_policies_are_refused(tmp_path: Path) -> None:
    scenario, uplink = Interruption(t_max=20), make_vec_env("bufgym:bufgym/Uplink-v1", 2, **WORLD, actions="slots")
    with pytest.raises(BufgymError, match="policy ppo: trained for L = 3, not for L = 5; only a network that scores"):
        run(as_policy(untrained(PPO, "MultiInputPolicy")), [scenario.episode(20)], 5, scenario.value)
    pole = untrained(PPO, "MlpPolicy", env_util.make_vec_env("CartPole-v1", 2)).policy
    few = make_vec_env("bufgym/Uplink-v1", 2, fields=["rank"], observation="flat", **WORLD, actions="slots")
    del few.observation_space.fields  # as of a wrapper that makes a space of its own
    for model, says in (
        (pole, r"action space Discrete\(2\): must be Discrete\(L \+ 2\)"),
        (untrained(PPO, "MlpPolicy", few), "observes 4 numbers: must be the"),
        (RecurrentPPO("MultiInputLstmPolicy", uplink, batch_size=16, n_steps=8), "recurrent"),
        (tmp_path / "none.zip", "no such file"),
    ):
        refuse(says, as_policy, model)

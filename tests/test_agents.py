"""The parts of training on a suite: padded rows, the slot network, double DQN, evaluation sets."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import Logger
from train_cases import DropOldest

from agents import mixed_env, runs
from agents.dqn import INVALID, SlotDQN, valid_actions
from agents.evaluation import EvaluationSet, SlotModel, sweep_for
from agents.settings import DQN, Evolve
from agents.tasks import Suites
from bufgym import policies
from bufgym.benchmark.run import run as rows_of
from bufgym.model import qoi
from bufgym.model.qoi import exponential
from bufgym.oracle import EveryLength
from bufgym.policies import weights
from bufgym.sb3 import GymVecEnv
from bufgym.sb3.networks import SlotExtractor, SlotScorer
from bufgym.scenario import Interruption, suites
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim import run
from bufgym.utils import files

SHORT = Interruption(law="uniform", t_min=6, t_max=30)
STEEP = dataclasses.replace(SHORT, value=exponential(0.2))
MIXED = [mixed_env.Cell("short", SHORT, 3), mixed_env.Cell("steep", STEEP, 5)]
SUITE = Evolve(suites=Suites(("interruption-v1",), capacities=(4, 8)), validation_episodes=60)


def mixed_rows(slots: int = 7) -> mixed_env.MixedEnv:
    """Four rows of each cell of MIXED, each with its own episode, padded to so many slots."""
    env = mixed_env.MixedEnv(MIXED, [4] * 2, slots)
    env.load([draw(cell.scenario, seed) for cell in MIXED for seed in range(4)])
    return env


def test_padded_slots_are_empty_and_masked() -> None:
    env = mixed_rows()
    for _ in range(6):  # as many arrivals as any episode has fill both kinds of buffer
        env.act(np.full(8, 8))
    live = ~env.ended()
    seen, masks = env.observation(), env.action_masks()
    assert live[:4].any() and live[4:].any()
    for rows, L in ((slice(0, 4), 3), (slice(4, 8), 5)):
        expected = [1.0] * L + [0.0] * (7 - L) + [1.0]  # the newcomer stays last
        assert (seen["occupied"][rows][live[rows]] == expected).all()
        assert (masks[rows][live[rows]] == [*map(bool, expected), False]).all()  # no room to accept
        assert (seen["occupancy"][rows][live[rows]] == 1.0).all()


@pytest.mark.parametrize("name", ["drop-oldest", "drop-newest"])
def test_a_padded_row_is_the_same_sender(name: str) -> None:
    """With 7 slots, 8 accepts, 7 rejects and 0 evicts the oldest, whatever the row's own L."""
    env = mixed_rows()
    while not env.ended().all():
        env.act(np.where(env.action_masks()[:, 8], 8, 0 if name == "drop-oldest" else 7))
    for (_, scenario, L), rows in zip(MIXED, env.groups, strict=True):
        senders = run(policies.get(name), [draw(scenario, seed) for seed in range(4)], L, scenario.value)
        reached = rows.summary(slice(None))
        assert reached["qoi"] == pytest.approx(1 + senders.batch.senders["delivered_gain"])
        assert not reached["invalid"].any()


def test_evicting_a_padded_slot_does_what_a_queue_does() -> None:
    env, queue = mixed_rows(), mixed_rows()
    while not env.ended().all():
        env.act(np.full(8, 6))  # a slot that no row has
        queue.act(np.where(queue.action_masks()[:, 8], 8, 7))
    for ours, theirs in zip(env.groups, queue.groups, strict=True):
        assert (ours.summary(slice(None))["qoi"] == theirs.summary(slice(None))["qoi"]).all()
        assert ours.summary(slice(None))["invalid"].any()


def test_rewards_add_up_to_the_information_and_rows_begin_anew() -> None:
    env = GymVecEnv(mixed_env.MixedEnv(MIXED, [3, 3], reward="retained"))
    env.seed(0)
    env.reset()
    ends = 0
    for _ in range(120):
        masks = np.stack(env.env_method("action_masks"))
        total = env._returns.copy()
        _, rewards, done, infos = env.step(np.where(masks[:, -1], 6, 0))
        for i in np.flatnonzero(done):
            assert infos[i]["episode"]["r"] == pytest.approx(total[i] + rewards[i])
            assert not any(column.any() for column in infos[i]["terminal_observation"].values())
            if ends > 12:  # a row's first episode is joined somewhere in its middle
                assert 0 < infos[i]["episode"]["r"] <= infos[i]["episode"]["l"]
            ends += 1
        assert np.stack(env.env_method("action_masks"))[done].any(axis=1).all()
    assert ends > 12


def scorer_of(env: mixed_env.MixedEnv, masked: bool = True) -> tuple[SlotExtractor, SlotScorer]:
    torch.manual_seed(0)
    features = SlotExtractor(env.single_observation_space)
    return features, SlotScorer(features, 8, masked)


def seen_in(env: mixed_env.MixedEnv) -> dict[str, torch.Tensor]:
    return {name: torch.as_tensor(column) for name, column in env.observation().items()}


def test_scores_and_values_do_not_change_with_padding() -> None:
    logits, values = [], []
    for slots in (5, 9):
        env = mixed_rows(slots=slots)
        env.act(np.full(8, slots + 1))
        env.act(np.full(8, slots + 1))
        features, scorer = scorer_of(env)
        with torch.no_grad():
            scores, value = scorer(features(seen_in(env)))
        logits.append(scores[torch.as_tensor(env.action_masks())])
        values.append(value)
    assert torch.allclose(*logits, atol=1e-6) and len(logits[0]) > 16
    assert torch.allclose(*values, atol=1e-6)


def test_leaving_empty_slots_out_changes_no_score_that_counts() -> None:
    env = mixed_rows()
    env.act(np.full(8, 8))
    seen = seen_in(env)
    features, packed = scorer_of(env)
    _, full = scorer_of(env, masked=False)
    full.load_state_dict(packed.state_dict())
    masks = torch.as_tensor(env.action_masks())
    ours, theirs = packed.forward_actor(features(seen)), full.forward_actor(features(seen))
    assert torch.allclose(ours[masks], theirs[masks], atol=1e-6)
    assert not torch.allclose(ours[~masks][:, None], theirs[~masks][:, None])
    # Gradients find the way back through the packing.
    ours[masks].sum().backward()
    theirs[masks].sum().backward()
    for a, b in zip(packed.score.parameters(), full.score.parameters(), strict=True):
        assert torch.allclose(a.grad, b.grad, atol=1e-4)  # type: ignore[arg-type]


@pytest.fixture
def dqn() -> Iterator[Any]:
    arguments = DQN(width=8, num_envs=8, batch_size=64, gamma=0.5)
    env = GymVecEnv(mixed_env.MixedEnv(MIXED, [4, 4]))
    model = SlotDQN(arguments).make(env)
    model.set_random_seed(0)
    yield model
    env.close()


def test_the_observation_tells_the_masks(dqn: Any) -> None:
    rng, env = np.random.default_rng(0), dqn.env
    seen = env.reset()
    for _ in range(60):
        masks = np.stack(env.env_method("action_masks"))
        assert (valid_actions(seen).numpy() == masks).all()
        q = dqn.q_net({name: torch.as_tensor(column) for name, column in seen.items()}).detach().numpy()
        assert ((q == INVALID) == ~masks).all()
        seen, _, _, _ = env.step((rng.random(masks.shape) * masks).argmax(axis=1))


def test_exploration_tries_all_valid_actions_and_no_others(dqn: Any) -> None:
    dqn.exploration_rate = 1.0
    dqn._last_obs = dqn.env.reset()
    masks = np.stack(dqn.env.env_method("action_masks"))
    tried = np.zeros_like(masks)
    for _ in range(100):
        tried[np.arange(8), dqn._sample_action(0, n_envs=8)[0]] = True
    assert (tried == masks).all()
    dqn.exploration_rate = 0.0
    greedy, _ = dqn.predict(dqn._last_obs)
    assert (dqn._sample_action(0, n_envs=8)[0] == greedy).all()


def test_targets_choose_by_one_network_and_value_by_the_other(dqn: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """reward 1, gamma 1/2: the online network prefers action 1 afterwards, which the target network gives 4, not its
    best 6: target 1 + 4/2 = 3. In the terminal row the target is the reward."""
    online = torch.nn.Parameter(torch.tensor([[0.0, 2.0, 1.0]]))
    monkeypatch.setattr(type(dqn.q_net), "forward", lambda self, obs: self.table.expand(2, -1))
    dqn.q_net.table, dqn.q_net_target.table = online, torch.nn.Parameter(torch.tensor([[6.0, 4.0, 5.0]]))
    dqn.policy.optimizer = torch.optim.SGD([online], lr=1.0)
    dqn.lr_schedule = lambda _: 1.0

    seen: dict[str, Any] = {"observations": None, "next_observations": None, "rewards": torch.ones(2, 1)}
    seen |= {"actions": torch.tensor([[0], [2]]), "dones": torch.tensor([[0.0], [1.0]])}
    dqn.replay_buffer = SimpleNamespace(sample=lambda batch_size: SimpleNamespace(**seen))
    dqn._logger = Logger(None, [])
    dqn.train(1, batch_size=2)
    # Huber's slope is 1 beyond 1, halved by the mean over two rows: Q(0) moves from 0 towards 3 by 1/2; Q(2) = 1 stays.
    assert online.detach().numpy() == pytest.approx(np.array([[0.5, 2.0, 1.0]]))


def test_an_agent_that_acts_like_a_policy_has_its_rows_and_its_score(tmp_path: Path) -> None:
    few = dataclasses.replace(SUITE, validation_episodes=12)
    plan, file = sweep_for(few, "interruption-v1", "validation"), tmp_path / "set" / "manifest.json"
    evaluation = EvaluationSet(plan, tmp_path / "set")
    assert len(evaluation.fixed("afr")) == 12
    assert evaluation.verdict(evaluation.play(SlotModel(DropOldest(), 8))).score == 0
    rows = evaluation.benchmark_rows(evaluation.play(SlotModel(DropOldest(), 10)), "agent", training_seed=7)  # padded
    fixed = {(r["scenario"], r["seed"], r["capacity"]): r for r in evaluation.rows if r["policy"] == "drop-oldest"}
    assert len(rows) == len(fixed) == 12
    for row in rows:
        other = fixed[row["scenario"], row["seed"], row["capacity"]] | {"policy": "agent", "training_seed": 7}
        assert row == pytest.approx(other, nan_ok=True)
    # A second reading makes nothing anew.
    written = file.stat().st_mtime_ns
    assert (EvaluationSet(plan, tmp_path / "set").fixed("afr") == evaluation.fixed("afr")).all()
    assert file.stat().st_mtime_ns == written


def test_a_record_goes_on_where_the_checkpoint_was(tmp_path: Path) -> None:
    columns = ("steps", "seconds", "qoi")
    record = runs.Record(tmp_path / "curve.csv", columns, 0)
    for steps in (10, 20, 30):
        record.append(steps, steps / 10, 0.5)
    assert runs.Record(tmp_path / "curve.csv", columns, 20).rows == [(10, 1, 0.5), (20, 2, 0.5)]
    assert (tmp_path / "curve.csv").read_text().split() == ["steps,seconds,qoi", "10,1.0,0.5", "20,2.0,0.5"]


def test_the_best_validation_is_the_earliest_of_equals(tmp_path: Path) -> None:
    validations = runs.Validations(tmp_path, ("regret",), min, Evolve(steps=40, validate_every=20), 0)
    assert validations.due(0)
    best = [validations.add(steps, 0.0, (regret,)) for steps, regret in ((0, 0.5), (20, 0.4), (30, 0.4))]
    assert best == [True, True, False] and validations.best[0] == 20
    assert [validations.due(steps) for steps in (30, 40, 49, 50)] == [False, True, True, True]


# The agents that come with bufgym: small, named, with their command, and as good as their file says.

SHIPPED = files.shipped("agents", "agents/pretrained", "*.safetensors")
NAMED = files.shipped("agents/named", "agents/pretrained/named", "*.safetensors")
TOPICS = files.shipped("agents/topics", "agents/pretrained/topics", "*.safetensors")


@pytest.mark.parametrize("name", {**SHIPPED, **TOPICS, **NAMED})
def test_its_file_is_small_and_tells_how_it_was_made(name: str) -> None:
    file = {**SHIPPED, **TOPICS, **NAMED}[name]
    _, meta = weights.read(file)
    policy = policies.get(name)
    assert file.stat().st_size < (8_000 if name not in NAMED else 200_000)
    assert meta["name"] == name and meta["training"].startswith(("python train.py --suite ", "python -m agents.joint "))
    assert meta["seeds"] and policy.summary == meta["about"] != ""
    assert (policy.for_topics, policy.named_only) == (name in TOPICS, name in NAMED)
    assert name in policies.names(for_topics=name in TOPICS, named_only=name in NAMED)


def test_until_the_link_has_carried_anything_learned_is_the_rule() -> None:
    """In an interruption, over every length of the test split."""
    for setting in suites.get("interruption-v1").settings("test").values():
        lengths = EveryLength(setting.scenario, (4, 16))
        assert lengths.regrets(policies.get("learned")) == lengths.regrets(policies.get("gap-price"))


@pytest.mark.parametrize("name", SHIPPED)
def test_over_a_link_that_flows_it_is_worth_more_than_afr(name: str) -> None:
    """On a link of a quarter of the demand, and over the fading links of generated-v1's validation."""
    for suite, label in (("sustained-v1", "time-quarter"), ("generated-v1", "time-900kB")):
        scenario = suites.get(suite).settings("validation")[label].scenario
        episodes = [draw(one, seed=1) for _, one in by_trace(scenario)]
        rivals = (policies.get("afr"), policies.get(name))
        afr, ours = (run(one, episodes, 10, scenario.value).batch.senders["delivered_gain"].sum() for one in rivals)
        assert afr < ours


@pytest.mark.parametrize("name", SHIPPED)
def test_its_weights_serve_other_v_and_l(name: str) -> None:
    """L = 100 with a V of the user's own."""
    scenario = Interruption(t_max=600, value=qoi.tabulated([0, 3, 10], [0, 0.7, 1]))
    senders = run(policies.get(name), [scenario.episode(600)], 100, scenario.value).batch.senders
    assert (senders["transmitted"][0], senders["invalid"][0]) == (102, 0)


@pytest.mark.nightly
def test_on_the_first_test_episode_of_each_setting_the_scheduler_is_above_robofleet() -> None:
    """Weighted QoI is larger; the first topics no older; no message lost that may not be."""
    names, settings = ("learned-scheduler", "robofleet"), suites.get("topics-v1").settings("test")
    rivals = [policies.get(name) for name in names]
    ages = dict.fromkeys(names, 0.0)
    for label, setting in settings.items():
        rows = rows_of(rivals, by_trace(setting.scenario)[0][1], (32,), [0], label=label)
        ours, theirs = ([row for row in rows if row["policy"] == name] for name in names)
        assert ours[0]["weighted_qoi"] > theirs[0]["weighted_qoi"]
        assert sum(row["lost"] for row in ours if row["no_drop"]) == 0
        for row in rows:
            ages[row["policy"]] += row["mean_age_s"] * (row["priority"] == 20)
    assert ages["learned-scheduler"] < ages["robofleet"]

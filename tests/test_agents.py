"""The parts of training on a suite: rows of different L side by side, the slot network, double DQN, evaluation sets."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for extra in ("sb3_contrib", "tqdm", "tensorboard"):
    pytest.importorskip(extra, reason="the extra [train] is not installed")

import torch  # noqa: E402  (these need the extra)

from agents import mixed_env, runs, training  # noqa: E402
from agents.dqn import INVALID, valid_actions  # noqa: E402
from agents.evaluation import EvaluationSet, seeds_for, sweep_for  # noqa: E402
from agents.settings import Settings  # noqa: E402
from bufgym import policies  # noqa: E402
from bufgym.benchmark.run import draw  # noqa: E402
from bufgym.benchmark.sweep import Sweep  # noqa: E402
from bufgym.errors import BufgymError  # noqa: E402
from bufgym.model.qoi import exponential  # noqa: E402
from bufgym.sb3 import GymVecEnv  # noqa: E402
from bufgym.sb3.networks import SlotExtractor, SlotScorer  # noqa: E402
from bufgym.scenario import Interruption  # noqa: E402
from bufgym.sim import run  # noqa: E402

SHORT = Interruption(law="uniform", t_min=6, t_max=30)
STEEP = dataclasses.replace(SHORT, value=exponential(0.2))
MIXED = [mixed_env.Cell("short", SHORT, 3), mixed_env.Cell("steep", STEEP, 5)]
SUITE = Settings(suite="interruption-v1", capacities="4,8", validation_episodes=60)


class DropOldest:
    """Accepts where that is possible, else evicts slot 0; remembers nothing."""

    def predict(self, observation: Any, *, deterministic: bool = False, action_masks: Any = None) -> Any:
        last = action_masks.shape[1] - 1
        return np.where(action_masks[:, last], last, np.where(action_masks[:, 0], 0, last - 1)), None


def mixed_rows(rows: int = 4, slots: int = 7) -> mixed_env.MixedEnv:
    """So many rows of each cell of MIXED, each with its own episode, padded to so many slots."""
    env = mixed_env.MixedEnv(MIXED, [rows] * 2, slots)
    env.load([draw(cell.scenario, seed) for cell in MIXED for seed in range(rows)])
    return env


# --- rows of different L side by side --------------------------------------------------------------------------------


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
    reached = [rows.summary(slice(None))["qoi"] for rows in env.groups]
    for cell, ours in zip(MIXED, reached, strict=True):
        senders = run(
            policies.get(name), [draw(cell.scenario, s) for s in range(4)], cell.capacity, cell.scenario.value
        )
        assert ours == pytest.approx(1 + senders.batch.senders["delivered_gain"])
    assert not any(rows.summary(slice(None))["invalid"].any() for rows in env.groups)


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


def test_rows_begin_at_different_points_of_their_episodes() -> None:
    env = mixed_env.MixedEnv([mixed_env.Cell("long", Interruption(law="fixed", t_max=60), 4)], [16])
    env.reset(seed=1)
    arrived = env.groups[0].senders.batch.senders["next"]
    assert len(np.unique(arrived)) > 8
    assert arrived.max() > 30
    again = mixed_env.MixedEnv([mixed_env.Cell("long", Interruption(law="fixed", t_max=60), 4)], [16])
    again.reset(seed=1)
    assert (again.groups[0].senders.batch.senders["next"] == arrived).all()


def test_mistakes_are_named() -> None:
    assert Settings().capacities_of("lte-v1") == (5, 10, 15, 20, 25)
    assert Settings(capacities="25,5").capacities_of("lte-v1") == (25, 5)
    for wrong in ("5,x", "0", "5,5"):
        with pytest.raises(BufgymError, match="capacities"):
            Settings(capacities=wrong).capacities_of("lte-v1")
    with pytest.raises(BufgymError, match="2 padded slots: a cell has L = 5"):
        mixed_env.MixedEnv(MIXED, [1, 1], padded_slots=2)


# --- networks --------------------------------------------------------------------------------------------------------


def scorer_of(env: mixed_env.MixedEnv, masked: bool = True) -> tuple[SlotExtractor, SlotScorer]:
    torch.manual_seed(0)
    features = SlotExtractor(env.single_observation_space)
    return features, SlotScorer(features, 8, masked)


def test_scores_and_values_do_not_change_with_padding() -> None:
    logits, values = [], []
    for slots in (5, 9):
        env = mixed_rows(slots=slots)
        env.act(np.full(8, slots + 1))
        env.act(np.full(8, slots + 1))
        features, scorer = scorer_of(env)
        with torch.no_grad():
            scores, value = scorer(features({name: torch.as_tensor(seen) for name, seen in env.observation().items()}))
        possible_now = torch.as_tensor(env.action_masks())
        logits.append(scores[possible_now])
        values.append(value)
    assert torch.allclose(*logits, atol=1e-6)
    assert torch.allclose(*values, atol=1e-6)
    assert len(logits[0]) > 16


def test_leaving_empty_slots_out_changes_no_score_that_counts() -> None:
    env = mixed_rows()
    env.act(np.full(8, 8))
    seen = {name: torch.as_tensor(column) for name, column in env.observation().items()}
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


# --- double DQN ------------------------------------------------------------------------------------------------------


@pytest.fixture
def dqn() -> Iterator[Any]:
    arguments = dataclasses.replace(SUITE, algo="dqn", width=8, num_envs=8, n_steps=16, batch_size=64, gamma=0.5)
    env = GymVecEnv(mixed_env.MixedEnv(MIXED, [4, 4]))
    model = training.new_dqn(arguments, env)
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
    for _ in range(300):
        actions, _ = dqn._sample_action(0, n_envs=8)
        tried[np.arange(8), actions] = True
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

    class Replay:
        def sample(self, batch_size: int) -> Any:
            from types import SimpleNamespace

            column = torch.tensor([[1.0], [1.0]])
            return SimpleNamespace(
                observations=None,
                next_observations=None,
                actions=torch.tensor([[0], [2]]),
                rewards=column,
                dones=torch.tensor([[0.0], [1.0]]),
            )

    dqn.replay_buffer = Replay()
    dqn._logger = callbacks_logger()
    dqn.train(1, batch_size=2)
    # Huber's slope is 1 beyond 1, halved by the mean over two rows: Q(0) moves from 0 towards 3 by 1/2; Q(2) = 1 stays.
    assert online.detach().numpy() == pytest.approx(np.array([[0.5, 2.0, 1.0]]))


def callbacks_logger() -> Any:
    from stable_baselines3.common.logger import Logger

    return Logger(None, [])


# --- evaluation sets -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_agent_that_acts_like_a_policy_has_its_rows_and_its_score(tmp_path: Path) -> None:
    evaluation = EvaluationSet(sweep_for(SUITE, SUITE.suite, "validation"), tmp_path / "set")
    assert len(evaluation.fixed("afr")) == 60
    assert evaluation.verdict(evaluation.play(DropOldest(), 8)).score == 0
    outcomes = evaluation.play(DropOldest(), 10)  # padding does not matter
    rows = evaluation.benchmark_rows(outcomes, "agent", training_seed=7)
    fixed = {(r["scenario"], r["seed"], r["capacity"]): r for r in evaluation.rows if r["policy"] == "drop-oldest"}
    assert len(rows) == len(fixed) == 60
    for row in rows:
        other = fixed[row["scenario"], row["seed"], row["capacity"]]
        assert {k: v for k, v in row.items() if k not in ("policy", "training_seed")} == pytest.approx(
            {k: v for k, v in other.items() if k != "policy"}, nan_ok=True
        )
    # A second reading makes nothing anew.
    written = (tmp_path / "set" / "manifest.json").stat().st_mtime_ns
    again = EvaluationSet(sweep_for(SUITE, SUITE.suite, "validation"), tmp_path / "set")
    assert (again.fixed("afr") == evaluation.fixed("afr")).all()
    assert (tmp_path / "set" / "manifest.json").stat().st_mtime_ns == written


def test_as_many_episodes_as_asked_for_or_at_least_one_a_trace() -> None:
    # interruption-v1 has 3 scenarios without traces: at two capacities one seed is 6 episodes.
    assert seeds_for("interruption-v1", "validation", (4, 8), 60, None) == 10
    assert seeds_for("interruption-v1", "validation", (4, 8), 1, None) == 1


def test_nothing_to_be_gained_is_an_error(tmp_path: Path) -> None:
    evaluation = EvaluationSet(Sweep("interruption-v1", ("afr",), "validation", (500,), 1), tmp_path / "set")
    with pytest.raises(BufgymError, match="cannot be bettered"):
        evaluation.verdict(evaluation.run(policies.get("drop-oldest")))


def test_a_record_goes_on_where_the_checkpoint_was(tmp_path: Path) -> None:
    columns = ("steps", "seconds", "qoi")
    record = runs.Record(tmp_path / "curve.csv", columns, 0)
    for steps in (10, 20, 30):
        record.append(steps, steps / 10, 0.5)
    assert runs.Record(tmp_path / "curve.csv", columns, 20).rows == [(10, 1, 0.5), (20, 2, 0.5)]
    assert (tmp_path / "curve.csv").read_text().split() == ["steps,seconds,qoi", "10,1.0,0.5", "20,2.0,0.5"]


def test_the_best_validation_is_the_earliest_of_equals(tmp_path: Path) -> None:
    settings = Settings(steps=40, validate_every=20)
    validations = runs.Validations(tmp_path, ("regret",), min, settings, 0)
    assert validations.due(0)
    assert [validations.add(steps, 0.0, (regret,)) for steps, regret in ((0, 0.5), (20, 0.4), (30, 0.4))] == [
        True,
        True,
        False,
    ]
    assert validations.best[0] == 20
    assert [validations.due(steps) for steps in (30, 40, 49, 50)] == [False, True, True, True]

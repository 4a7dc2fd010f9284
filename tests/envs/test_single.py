"""The single environment: Gymnasium's own checks, rewards by hand, masks, wrong use; what it returns."""

import copy
import math
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import DYING, FADING, same
from refusal_cases import refused

from bufgym.envs import SenderEnv
from bufgym.jit import named
from bufgym.model import qoi
from bufgym.model.buffer import UNLIMITED_BYTES, Buffer
from bufgym.model.link import Link
from bufgym.model.observe import CONTEXT_FIELDS, FIELDS, TOPIC_CONTEXT_FIELDS
from bufgym.scenario import Episode, Interruption, Scenario, Uplink, messages
from bufgym.sim.rollout import python_view
from bufgym.traces import Trace, drive_motion

kernels = pytest.mark.kernels
SCENARIOS: dict[str, Scenario] = {
    "interruption": Interruption(t_max=25),
    "fading": Uplink(traces=(FADING,), jitter=0.8, size_cv=0.7, duration_s=1.5),
    "moving": Uplink(traces=(FADING,), motion=(drive_motion(3, 30),), duration_s=1.5, value=qoi.saturating(0.2)),
    "dying": Uplink(traces=(DYING,), duration_s=1.5, random_offset=False),
}
BYTES = {"max_bytes": 600_000}
VARIANTS: list[tuple[str, dict[str, Any]]] = [
    ("interruption", {"decide_at": "overflow"}),
    ("fading", {}),
    ("fading", BYTES),
    ("moving", {"decide_at": "overflow", **BYTES}),
    ("dying", {}),
]


def make(scenario: str = "fading", **options: Any) -> SenderEnv:
    return SenderEnv(SCENARIOS[scenario], 4, **{"reward": "retained", **options}, actions="slots")


def begun(**options: Any) -> SenderEnv:
    env = make(**options)
    env.reset(seed=0)
    return env


def seen(env: SenderEnv) -> tuple[Buffer, Any]:
    """The Buffer and the newcomer as a policy of plain Python gets them."""
    batch = named(env.sub_envs.senders.batch)
    return python_view(batch, 0), batch.arrivals[0, batch.senders[0].next]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_plays_on_and_begins_anew_as_the_original(copied: Any) -> None:
    def rest(env: SenderEnv) -> list[Any]:
        seen = [(env.step(4)[1], env.action_masks().tolist()) for _ in range(5)]
        obs, _ = env.reset()
        return [*seen, {key: obs[key].tolist() for key in obs}, [env.step(k % 5)[:2] for k in range(10)]]

    env = begun()
    env.step(4)
    assert str(rest(copied(env))) == str(rest(env))


def test_fields_choose_what_is_observed() -> None:
    env, everything = make(fields=["service_ratio", "loss"]), make()
    few, all_of_it = env.reset(seed=3)[0], everything.reset(seed=3)[0]
    assert set(env.observation_space) == set(few) == {"loss", "service_ratio"}
    assert set(all_of_it) == {field.name for field in FIELDS}
    assert same(few, {name: all_of_it[name] for name in few})
    assert (env.observation_space["loss"].shape, env.observation_space["service_ratio"].shape) == ((5,), (1,))


@kernels
def test_rewards_worked_by_hand() -> None:
    """L = 2, T = 4. Message 0 is in transmission; 1 and 2 are accepted; 3 evicts one of them; 4 is rejected; 5 follows.

    Delivered are 0, 1 or 2, 3, 5: H = 1 + V(1) + V(2) + V(2) in both cases.
    """
    v1, v2 = 1 - 0.618, 1 - 0.618**2
    for slot in (0, 1):
        env = SenderEnv(Interruption(law="fixed", t_max=4), 2, reward="retained", actions="slots")
        env.reset(seed=0)
        rewarded = []
        for action in (3, 3, slot, 2):
            _, reward, ended, truncated, info = env.step(action)
            rewarded.append((info["reward_terms"]["retained"], info["reward_terms"]["delivered"]))
            assert reward == info["reward_terms"]["retained"]
            assert not truncated
        assert ended
        np.testing.assert_allclose(rewarded, [(v1, 0), (v1, 0), (v2 - v1, 0), (v2, v1 + v2 + v2)], atol=1e-15)
        assert info["qoi"] == pytest.approx(1 + v1 + 2 * v2)
        assert (info["arrived"], info["delivered"], info["dropped"], info["invalid"]) == (6, 4, 2, 0)


@kernels
def test_a_message_that_arrives_at_the_server_as_the_step_ends_is_rewarded_in_it() -> None:
    """5 bytes take 5 us. 0 and 1 come at 0: 1 is received at 10 us, when 2 arrives; 2 at 15, before 3 comes."""
    link = Link(Trace("even", np.array([0, 1_000]), np.array([0, 1_000])))
    env = SenderEnv(Interruption(t_max=25, value=qoi.saturating(4)), 3, reward="delivered", actions="slots")
    env.reset(options={"episode": Episode(messages(np.array([0, 0, 10, 20]), 5), link)})
    assert [env.step(4)[1] for _ in range(4)] == [0.0, 0.25, 0.25, 0.25]


@kernels
@pytest.mark.parametrize(("scenario", "options"), VARIANTS)
def test_every_step_of_random_play(scenario: str, options: dict[str, Any]) -> None:
    """Masks, bounds, sums of rewards and what became of all, under actions of which many are invalid."""
    env, rng = make(scenario, **options), np.random.default_rng(1)
    L, most = env.sub_envs.capacity, options.get("max_bytes", UNLIMITED_BYTES)
    for seed in (7, None):
        observation, info = env.reset(seed=seed)
        ended, total, invalid = False, np.zeros(2), 0
        held: list[Any] = []
        while not ended:
            assert env.observation_space.contains(observation)
            held.append((observation, {name: array.copy() for name, array in observation.items()}))
            allowed = [True] * (L + 2)  # an episode that asks for no decision: actions have no effect
            if env.sub_envs.senders.batch.senders[0]["waiting"]:
                buffer, arrival = seen(env)
                room = most - buffer.backlog_bytes - arrival.size_bytes
                allowed = [k < len(buffer.slots) for k in range(L)]
                allowed += [True, len(buffer.slots) < L and room >= 0]
                assert info["action_mask"].tolist() == env.action_masks().tolist() == allowed
                assert "decide_at" not in options or not allowed[L + 1]
            action = int(rng.integers(L + 2))
            invalid += not allowed[action]
            observation, reward, ended, truncated, info = env.step(action)
            assert not truncated and info["invalid"] == invalid
            terms = info["reward_terms"]
            total += terms["delivered"], terms["retained"]
            assert reward == terms["retained"]
        sender, log, n = env.sub_envs.senders.batch.senders[0], env.sub_envs.senders.batch.log[0], info["arrived"]
        assert n == len(env.sub_envs.senders.episodes[0].arrivals)
        assert n == info["delivered"] + info["dropped"] + sender["busy"] + sender["occupancy"]
        assert all(same(*observations) for observations in held)  # never written again
        np.testing.assert_allclose(total, max(0.0, info["qoi"] - 1), atol=1e-9)
        # H by its definition, from what crossed.
        x = env.sub_envs.senders.episodes[0].arrivals["x"][log["transmitted_us"][:n] >= 0]
        assert info["qoi"] == pytest.approx(env.sub_envs.scenario.value.information(np.sort(x)))
    if scenario == "dying":
        assert sender["occupancy"] + sender["busy"] > 0  # stranded, and still all sums hold


@kernels
def test_an_episode_that_asks_for_no_decision_ends_with_the_first_step() -> None:
    env = SenderEnv(Interruption(law="fixed", t_max=3), 8, decide_at="overflow", reward="retained", actions="slots")
    observation, info = env.reset(seed=0)
    assert info["action_mask"].tolist() == [False] * 8 + [True, False]
    assert not any(array.any() for array in observation.values())
    _, reward, ended, _, info = env.step(0)
    assert ended
    assert (info["delivered"], info["dropped"], info["invalid"]) == (5, 0, 0)
    assert reward == pytest.approx(4 * (1 - 0.618))
    assert info["qoi"] == pytest.approx(1 + 4 * (1 - 0.618))


@kernels
def test_observation_bounds_hold_where_nothing_moves_and_all_comes_at_once() -> None:
    """Arrivals at one moment, x that stands still: every reference length is 0."""
    episode = Episode(messages(np.zeros(9, np.int64), 1000, np.zeros(9)), Link(Trace.steps([(1.0, 0), (1.0, 1e6)])))
    env = SenderEnv(Interruption(t_max=25), 3, actions="slots")
    observation, _ = env.reset(seed=0, options={"episode": episode})
    ended = False
    while not ended:
        assert env.observation_space.contains(observation)
        observation, _, ended, _, info = env.step(4)
    assert info["arrived"] == 9
    assert info["qoi"] == 1.0


@pytest.mark.parametrize(
    ("info", "always"), [("full", {"action_mask", "qoi", "invalid", "reward_terms"}), ("mask", {"action_mask"})]
)
def test_info_is_built_as_far_as_asked(info: str, always: set[str]) -> None:
    """T = 2, all accepted: the second step delivers 0, 1, 2, 3 and ends the episode."""
    env = SenderEnv("interruption", 4, law="fixed", t_max=2, info=info, actions="slots")
    assert env.reset(seed=0)[1].keys() == env.step(5)[4].keys() == always
    last, summary = env.step(5)[4], {"arrived": 4, "delivered": 4, "dropped": 0, "invalid": 0}
    assert last.keys() == always | summary.keys() | {"qoi"}
    assert {name: last[name] for name in summary} == summary and last["qoi"] == pytest.approx(1 + 3 * (1 - 0.618))


def test_a_library_that_tries_an_argument_sees_pythons_own_error() -> None:
    """As TorchRL does: it passes ``frameskip`` and leaves it out at Python's words."""
    for make_one in (gym.make, gym.make_vec):
        with pytest.raises(
            TypeError, match=r"^Uplink\.__init__\(\) got an unexpected keyword argument 'frameskip': unknown"
        ):
            make_one("bufgym/Uplink-v1", frameskip=1)
    with pytest.raises(ValueError, match="'capacty'; did you mean 'capacity'"):
        SenderEnv(capacty=3, actions="slots")


WHOLE, INVALID = r"must be a whole number in 0\.\.5 \(L = 4\)", gym.error.InvalidAction


test_wrong_use_is_named = refused(
    (lambda: SenderEnv(capacity=0, actions="slots"), "capacity = 0"),
    (lambda: SenderEnv(reward="fame", actions="slots"), "unknown term 'fame'"),
    (lambda: SenderEnv(reward={"delivered": math.nan}, actions="slots"), "finite"),
    (lambda: SenderEnv(reward={}, actions="slots"), "at least one term"),
    (lambda: SenderEnv(fields=["smell"], actions="slots"), "unknown field 'smell'"),
    *((lambda f=f: SenderEnv(fields=f, actions="slots"), "must be a list of names") for f in ("rank", 3, [3])),
    (lambda: SenderEnv(decide_at="noon", actions="slots"), "decide_at = 'noon'"),
    (lambda: SenderEnv(max_bytes=0, actions="slots"), "max_bytes = 0"),
    (lambda: SenderEnv(render_mode="depth_array", actions="slots"), "render_mode = 'depth_array'"),
    (lambda: SenderEnv(observation="image"), "observation = 'image': must be one of 'dict', 'flat', None"),
    (lambda: SenderEnv(actions="guided"), "unknown actions 'guided'; known: candidates, slots"),
    *((lambda a=a: begun().step(a), rf"action = .*: {WHOLE}", INVALID) for a in (1.7, np.array([1]), "1", None)),
    (lambda: begun().step(6), r"action = 6: must be a whole number in 0\.\.5", INVALID),
    (lambda: make("interruption").reset(options={"episode": Interruption(t_max=30).episode(30)}), "room for 27"),
)


def test_an_episode_that_has_ended_takes_no_step() -> None:
    env = SenderEnv(Interruption(t_max=3), 2, actions="slots")
    with pytest.raises(gym.error.ResetNeeded, match=r"^call reset\(\) before step"):
        env.step(0)
    env.reset(seed=0)
    while not env.step(0)[2]:
        pass
    with pytest.raises(gym.error.ResetNeeded, match="the episode has ended"):
        env.step(0)
    env.reset()
    env.step(0)


def test_what_someone_holds_stays_as_it_is() -> None:
    """The dict, one of its arrays, a part of one, or what shares an array's memory."""
    sub_envs = make().sub_envs

    def handed(number: float) -> Any:
        sub_envs.output.flat[0] = number
        return sub_envs.observation(0)

    dict_held, array_held, part_held = handed(1), handed(2)["rank"], handed(3)["loss"][1:]
    shared = memoryview(handed(4)["size"])
    for number in range(5, 12):
        assert handed(number)["busy"][0] == number
    assert all((array == 1).all() for array in dict_held.values())
    assert (array_held == 2).all() and (part_held == 3).all() and list(shared) == [4] * len(shared)


@pytest.mark.parametrize("id", ["bufgym/Uplink-v1", "bufgym/Topics-v0"])
def test_the_context_alone_is_that_of_all_fields(id: str) -> None:
    fields = [field.name for field in CONTEXT_FIELDS + (TOPIC_CONTEXT_FIELDS if "Topics" in id else ())]
    whole, alone = (gym.make_vec(id, 3, capacity=5, actions="slots", fields=names) for names in (None, fields))
    (seen, _), (part, _) = whole.reset(seed=1), alone.reset(seed=1)
    for action in range(60):
        context = [name for name, numbers in seen.items() if numbers.shape[1] == 1]
        assert list(part) == context
        assert all((part[name] == seen[name]).all() for name in context)
        (seen, *_), (part, *_) = whole.step(np.full(3, action % 7)), alone.step(np.full(3, action % 7))


def test_what_an_owner_does_to_a_batch_s_dicts_changes_no_other() -> None:
    batch = gym.make_vec("bufgym/Uplink-v1", 2, capacity=3, actions="slots")
    batch.reset(seed=1)
    for _ in range(9):
        seen, *_, info = batch.step(np.zeros(2, np.int64))
        assert {"rank", "busy"} <= set(seen) and {"qoi", "_qoi"} <= set(info) and "retained" in info["reward_terms"]
        seen.clear()
        info["reward_terms"].clear()
        info.clear()

"""Observation fields and reward terms of one's own, by hand and in a batch; what a discount does to built-in rewards.

``retained`` is ``delivered`` + F(after) - F(before), where F is the QoI held. The sums of both are H - 1. With a
discount g, ``retained`` also pays (1 - g) F in every step: it pays for a full queue. ``retained`` - (1 - g) F is
``delivered`` + g F(after) - F(before), which changes no best policy (Ng, Harada and Russell 1999).
"""

import math
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import SMALL, valid_action
from needs import needs
from refusal_cases import refuse, refused

import bufgym
from bufgym.envs import FleetVecEnv, SenderEnv, SenderVectorEnv
from bufgym.envs.options import Options
from bufgym.envs.sub_envs import SubEnvs
from bufgym.jit import JIT
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.observe import field, reward_term
from bufgym.scenario import Episode, Uplink, messages
from bufgym.scenario.numbered import draw
from bufgym.sim.metrics import outcome, received
from bufgym.traces import Trace

SECOND_US = 1_000_000


def waited(buffer: Any, arrival: Any, k: int) -> float:
    """Seconds since slot k arrived, as a share of ten."""
    arrival_us = arrival.arrival_us if k == len(buffer.slots) else buffer.slots[k].arrival_us
    return (buffer.now_us - arrival_us) / 1e7


def megabytes(buffer: Any, arrival: Any) -> float:
    """Megabytes queued, and of the newcomer a tenth."""
    return (buffer.backlog_bytes + 0.1 * arrival.size_bytes) / 1e6


def dropped(step: Any, memory: Any) -> float:
    """Minus the drops; the step's number in the last digits."""
    memory[0] += 1
    return -step.drops - 1e-6 * memory[0]


@pytest.fixture(autouse=True)
def own() -> None:
    """Each function twice: in plain Python (``_py``) and compiled."""
    for suffix, compiled in (("", True), ("_py", False)):
        field(f"wait{suffix}", per="slot", unit="g/10 s", compile=compiled)(waited)
        field(f"megabytes{suffix}", per="context", high=1e3, compile=compiled)(megabytes)
        reward_term(f"dropped{suffix}", memory={"steps": 0}, compile=compiled)(dropped)


CHOSEN = ["loss", "wait", "wait_py", "occupancy", "megabytes", "megabytes_py"]
EVERYWHERE = {"retained": 1.0, "delay": 0.1, "energy": 0.2, "dropped": 0.3, "dropped_py": 0.0}
ONE_QUEUE = {**EVERYWHERE, "age": 0.1, "late:deadline_s=0.4": 0.5}


def terms_of(env_id: str) -> dict[str, float]:
    return EVERYWHERE if "Topics" in env_id else ONE_QUEUE


MB = 1_000_000


def episode(bytes_per_s: float) -> Episode:
    """Four messages of 1 MB, a second apart, over a steady link; half a second of propagation."""
    arrivals = messages(np.arange(4) * SECOND_US, MB)
    return Episode(arrivals, Link(Trace.steps([(100.0, bytes_per_s)]), 0, SECOND_US // 2))


def sums(link: float, reward: dict[str, float], action: int) -> dict[str, float]:
    """The sum of each term over the episode, L = 1, always this action."""
    env = SenderEnv(Uplink(traces=(Trace.steps([(1.0, 1e6)]),)), 1, reward=reward, actions="slots")
    _, info = env.reset(options={"episode": episode(link)})
    assert set(info["reward_terms"].values()) == {0.0}  # a reset has them too
    total, ended = dict.fromkeys(info["reward_terms"], 0.0), False
    while not ended:
        _, _, ended, _, info = env.step(action)
        for name, number in info["reward_terms"].items():
            total[name] += number
    return total


@pytest.mark.kernels
def test_terms_that_come_with_bufgym_by_hand() -> None:
    # At 1 MB/s every message goes at once: each takes 1 s and half a second to the server, 1.5, 2.5, 3.5, 4.5 s.
    # Until 2.5 s the age is t (3.125 s^2), then t - 1 until the last arrival at 3 s (1.5 to 2.0: 0.875 s^2).
    every = {"delay": 0.0, "energy": 0.0, "age": 0.0, "late:deadline_s=1.4": 0.0, "late:deadline_s=1.6": 0.0}
    total = sums(1e6, every, 2)
    assert (total["delay"], total["energy"]) == (-6.0, -4.0)  # exactly
    assert total["age"] == pytest.approx(-4.0)
    assert (total["late:deadline_s=1.4"], total["late:deadline_s=1.6"]) == (-4.0, 0.0)
    # At half of that, message 2 is evicted for message 3: 0, 1 and 3 arrive at 2.5, 4.5 and 6.5 s.
    total = sums(0.5e6, {**every, "late:deadline_s=3": 0.0, "dropped": 1.0}, 0)
    assert total["delay"] == pytest.approx(-9.5)
    assert total["energy"] == pytest.approx(-3.0)
    assert total["age"] == pytest.approx(-(3.125 + 0.5 * 2.75))
    assert total["late:deadline_s=3"] == -2.0
    assert math.ceil(total["dropped"]) == -1


@pytest.mark.kernels
def test_a_step_tells_what_happened_in_it() -> None:
    steps: list[tuple[float, ...]] = []

    @reward_term("spy")
    def spy(step: Any, memory: Any) -> float:
        times = step.from_us / SECOND_US, step.until_us / SECOND_US
        steps.append((*times, list(step.transmitted), list(step.delivered), step.drops, step.queued, step.ended))
        for array in (step.messages, step.log, step.transmitted):
            assert not array.flags.writeable
        return float(len(step.messages))

    total = sums(0.5e6, {"spy": 1.0}, 0)
    assert steps == [
        (0.0, 1.0, [], [], 0, 0, False),
        (1.0, 2.0, [0], [], 0, 0, False),
        (2.0, 3.0, [], [0], 0, 1, False),
        (3.0, 6.5, [1, 3], [1, 3], 1, 0, True),
    ]
    assert total["spy"] == 2 + 3 + 4 + 4  # messages that have come by then


@pytest.mark.kernels
@pytest.mark.parametrize("env_id", bufgym.ENVIRONMENTS)
def test_compiled_and_plain_agree_and_sum_to_the_log(env_id: str) -> None:
    arguments: dict[str, Any] = {"fields": CHOSEN, "reward": terms_of(env_id), "capacity": 4, **SMALL[env_id]}
    env = gym.make(env_id, **arguments, actions="slots").unwrapped
    assert isinstance(env, SenderEnv)
    rng = np.random.default_rng(3)
    for seed in range(2):
        _, info = env.reset(seed=seed)
        total, ended = dict.fromkeys(info["reward_terms"], 0.0), False
        while not ended:
            seen, reward, ended, _, info = env.step(valid_action(info["action_mask"], rng))
            assert env.observation_space.contains(seen)
            assert list(seen) == ["loss", "wait", "wait_py", "occupancy", "megabytes", "megabytes_py"]
            for name in ("wait", "megabytes"):
                np.testing.assert_array_equal(seen[name], seen[f"{name}_py"])
            terms = info["reward_terms"]
            assert terms["dropped"] == terms["dropped_py"]
            assert reward == pytest.approx(sum(terms_of(env_id).get(name, 0.0) * terms[name] for name in terms))
            for name, number in terms.items():
                total[name] += number
        senders = env.sub_envs.senders
        result, count = outcome(senders, 0), int(senders.batch.senders["transmitted"][0])
        propagation_s = int(senders.batch.senders["propagation_us"][0]) / 1e6
        assert total["delay"] == pytest.approx(-count * (result.mean_sojourn_s + propagation_s))
        assert total["energy"] == pytest.approx(-received(senders, 0)["size_bytes"].sum() / 1e6)
        assert round(total["dropped"]) == -result.dropped


@pytest.mark.kernels
def test_a_batch_is_its_rows() -> None:
    arguments: dict[str, Any] = {"fields": CHOSEN, "reward": ONE_QUEUE, "capacity": 3, **SMALL["bufgym/Uplink-v1"]}
    singles = [SenderEnv("lte", **arguments, actions="slots") for _ in range(3)]
    batch = SenderVectorEnv(3, "lte", autoreset_mode="Disabled", **arguments, actions="slots")
    many, one = batch.reset(seed=5)[0], [env.reset(seed=5 + i)[0] for i, env in enumerate(singles)]
    for k in range(25):
        for name in CHOSEN:
            np.testing.assert_array_equal([seen[name] for seen in one], many[name], err_msg=name)
        many, rewards, *_ = batch.step(np.full(3, k % 5))
        steps = [env.step(k % 5) for env in singles]
        one = [step[0] for step in steps]
        assert rewards.tolist() == [step[1] for step in steps]


def test_a_term_of_the_end_is_asked_once_an_episode() -> None:
    """``prepare`` runs as the environment is made; the function sees the last step of each episode alone."""
    calls: list[Any] = []

    @reward_term("at_end", at_end=True, prepare=lambda: calls.append("ready"))
    def messages_left(step: Any, memory: Any) -> float:
        calls.append(step.ended)
        return len(step.log)

    single: Any = gym.make("bufgym/Uplink-v1", duration_s=1.0, reward="at_end", actions="slots")
    assert calls == ["ready"]
    single.reset(seed=0)
    steps = [single.step(0) for _ in range(30)]
    assert [reward for _, reward, *_ in steps] == [0.0] * 29 + [30.0] and calls == ["ready", True]
    batch: Any = gym.make_vec("bufgym/Uplink-v1", 3, duration_s=1.0, reward="at_end", actions="slots")
    batch.reset(seed=0)
    for _ in range(30):
        _, rewards, ended, *_ = batch.step(np.zeros(3, np.int64))
        assert (rewards == np.where(ended, 30.0, 0.0)).all()
    assert ended.all() and calls == ["ready", True, "ready", True, True, True]


@pytest.mark.kernels
def test_a_fleet_has_them_too() -> None:
    rewarded: dict[str, Any] = {"term": {"delay": 1.0, "dropped": 0.1}, "reward": "own"}
    envs = FleetVecEnv(2, 3, capacity=3, fields=CHOSEN, duration_s=1.0, **rewarded)
    envs.reset(seed=1)
    done = np.zeros(6, np.bool_)
    while not done.any():
        seen, rewards, done, _, info = envs.step(np.zeros(6, np.int64))
        np.testing.assert_array_equal(seen["wait"], seen["wait_py"])
        terms = info["reward_terms"]
        np.testing.assert_allclose(rewards, terms["delay"] + 0.1 * terms["dropped"])
        assert envs.single_observation_space.contains({name: array[0] for name, array in seen.items()})


MODULE = """
from bufgym.model.observe import field, reward_term

@field("from_a_module", per="context")
def seen(buffer, arrival):
    return 0.25

@reward_term("term_of_a_module")
def paid(step, memory):
    return 2.0

def nothing(buffer, arrival):
    return 0.0
"""


def test_a_spec_as_text_imports_what_it_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_text_module.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    arguments: dict[str, Any] = {"fields": ["rank", "own_text_module:seen"], "reward": {"own_text_module:paid": 3}}
    spec = gym.make("bufgym/Interruption-v1", **arguments, actions="slots").spec
    assert spec is not None
    env = gym.make(gym.envs.registration.EnvSpec.from_json(spec.to_json()))
    seen, _ = env.reset(seed=0)
    assert list(seen) == ["rank", "from_a_module"] and seen["from_a_module"] == [0.25]
    assert env.step(0)[1] == 6.0
    refuse("own_text_module:nothing: is not registered as a field", SenderEnv, fields=["own_text_module:nothing"])


def far(buffer: Any, arrival: Any) -> float:
    return 1.5


def odd(buffer: Any, arrival: Any) -> float:
    return float({"a": object()}["a"] is None)


def nothing(step: Any, memory: Any) -> float:
    return math.nan


def out_of_bounds(compiled: bool) -> None:
    field("far", per="context", compile=compiled)(far)
    SenderEnv("interruption", fields=["far"], actions="slots").reset(seed=0)


def no_number(compiled: bool) -> None:
    reward_term("n", compile=compiled)(nothing)
    env = SenderEnv("interruption", reward={"n": 0}, actions="slots")
    env.reset(seed=0)
    env.step(0)


test_what_is_refused = refused(
    (lambda: field("rank", per="slot")(waited), "field 'rank': a built-in field has this name"),
    (lambda: field("my field", per="slot")(waited), "without spaces"),
    (lambda: field("mine", per="row")(waited), "per = 'row': must be 'slot' or 'context'"),
    (lambda: field("mine", per="slot", low=1.0, high=2.0)(waited), "need low <= 0 <= high"),
    (lambda: field("mine", per="context")(waited), r"must be a function \(buffer, arrival\)"),
    (lambda: reward_term("retained")(dropped), "reward term 'retained': a built-in reward term has this name"),
    (lambda: reward_term("delay")(dropped), "reward term 'delay': a built-in reward term has this name"),
    (lambda: reward_term("mine")(waited), r"must be a function \(step, memory\)"),
    (
        lambda: SenderEnv(reward={"late:deadline=1": 1}, actions="slots"),
        "reward term late: unknown parameter 'deadline'",
    ),
    (lambda: SenderEnv(reward={"late:deadline_s=0": 1}, actions="slots"), "deadline_s = 0.0: must be a number > 0"),
    (lambda: SenderEnv(reward={"delay": "much"}, actions="slots"), "the weight of 'delay' must be a finite number"),
    (lambda: SenderEnv("topics", reward="late:deadline_s=1"), "is for one queue; each topic has"),
    (lambda: SenderEnv(tells_duration=2), "tells_duration = 2: must be True or False"),
    (lambda: SenderEnv(bound="yes", actions="slots"), "bound = 'yes': must be True or False"),
    *((lambda c=c: out_of_bounds(c), "field 'far': is 1.5: must lie in its bounds, 0..1") for c in (False, True)),
    *((lambda c=c: no_number(c), "reward term 'n': is no finite number") for c in (False, True)),
)


@pytest.mark.skipif(not JIT, reason=needs("compiled", "nothing is compiled"))
def test_what_is_no_kernel_says_so_in_one_line() -> None:
    field("odd", per="context", compile=True)(odd)
    refuse("field 'odd': is no kernel: ", SenderEnv, "interruption", fields=["odd"])


L, FRAMES = 2, 6
LINK = Trace.steps([(0.15, 9_000), (0.05, 3_000), (0.05, 1_500), (0.15, 500), (0.15, 0), (0.05, 9_000), (0.2, 4_000)])
SCENARIO = Uplink(traces=(LINK,), rate_hz=10, duration_s=FRAMES / 10, size_bytes=900, value=qoi.exponential(0.5))


@pytest.fixture(scope="module")
def played() -> tuple[Any, Any, Any]:
    """Delivered and retained rewards and the QoI held afterwards, float64[sequences, steps], of all sequences."""
    sequences = np.array(list(product(range(L + 2), repeat=FRAMES)))
    sub_envs = SubEnvs(len(sequences), SCENARIO, Options(capacity=L, actions="slots"))
    sub_envs.reset(np.arange(len(sub_envs)), [draw(SCENARIO, 0)] * len(sub_envs))
    rewards, held = [], []
    for actions in sequences.T:
        sub_envs.step(np.ascontiguousarray(actions))
        rewards.append(sub_envs.output.reward_terms[:, :2].copy())
        held.append(sub_envs.rewarded[:, 1] - sub_envs.rewarded[:, 0])
    assert sub_envs.output.terminated.all()
    delivered, retained = np.stack(rewards, axis=1).transpose(2, 0, 1)
    return delivered, retained, np.stack(held, axis=1)


def returns(rewards: Any, gamma: float) -> Any:
    """The discounted sum of each sequence."""
    return rewards @ gamma ** np.arange(rewards.shape[1])


def best(rewards: Any, gamma: float) -> set[int]:
    """The sequences with the largest return."""
    found = returns(rewards, gamma)
    return set(np.flatnonzero(found > found.max() - 1e-9).tolist())


@pytest.mark.parametrize("gamma", [0.3, 0.5, 0.9, 1.0])
def test_less_what_it_pays_the_best_sequences_are_those_of_delivered(played: Any, gamma: float) -> None:
    delivered, retained, held = played
    shaped = retained - (1 - gamma) * held
    assert returns(shaped, gamma) == pytest.approx(returns(delivered, gamma), abs=1e-12)
    assert best(shaped, gamma) == best(delivered, gamma)


def test_but_they_need_not_be_the_best_without_a_discount(played: Any) -> None:
    """An early delivery is worth more than a good one then: a quarter of a message is lost. ``retained`` loses none."""
    delivered, retained, _ = played
    total = returns(delivered, 1.0)
    assert max(total[list(best(delivered, 0.3))]) == pytest.approx(total.max() - 0.25)
    assert max(total[list(best(retained, 0.3))]) == pytest.approx(total.max())

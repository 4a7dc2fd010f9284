"""The rewards ``cost`` and ``paired`` by hand and by their sums over whole episodes, and actions that hold."""

import copy
import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import DYING, FADING
from refusal_cases import refused

from bufgym import policies
from bufgym.envs import FleetVecEnv, SenderEnv, SenderVectorEnv
from bufgym.jit import kernel
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import Episode, Interruption, Uplink, messages
from bufgym.scenario.numbered import draw
from bufgym.scenario.suites.mixture import SuiteScenario
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace, drive_motion

kernels = pytest.mark.kernels
BOTH = {"cost": 1.0, "paired": 1.0}
MOVING: dict[str, Any] = {"motion": (drive_motion(3, 30),), "rate_hz": 20, "duration_s": 2.0}
EQUAL = Uplink(traces=(Trace.steps([(0.3, 2_000_000), (0.7, 60_000)]),), **MOVING, value=qoi.exponential(0.05))
SIZES = Uplink(traces=(FADING,), **MOVING, jitter=0.8, size_cv=0.7, value=qoi.saturating(0.3))
DEAD = Uplink(traces=(DYING,), **MOVING, value=qoi.exponential(0.3))
HALF = qoi.exponential(0.5)


def test_by_hand() -> None:
    """L = 2, a message a second, x = 0..6, V(d) = 1 - 2^-d: 1/2, 3/4, 7/8, 15/16. Message 0 is in the socket for good.

    Each arrival takes off its step, 1/2, and closes the gap behind the last one kept. 3 comes and 1 goes: two gaps of 1
    become 2, 3/4 - 1. 4 is rejected: the gap behind 3 is 1, which costs nothing yet. 5 is rejected: it is 2, 3/4 - 1.
    6 comes and 3 goes: a gap of 1 and one of 2, 1/2 + 3/4, and the step of 6 become 4: 15/16 - 7/4. The sum is H - 1
    less six steps, 3/4 + 15/16 - 3.
    """
    episode = Episode(messages(np.arange(7) * 1_000_000, 100, x=np.arange(7.0)), Link(Trace.steps([(100.0, 1.0)])))
    env = SenderEnv(Interruption(t_max=20, value=HALF), 2, reward="cost", actions="slots", decide_at="overflow")
    env.reset(options={"episode": episode})
    steps = [env.step(action) for action in (0, 2, 2, 1)]
    assert [step[1] for step in steps] == pytest.approx([-1 / 4, 0, -1 / 4, -13 / 16])
    assert steps[-1][2] and steps[-1][4]["qoi"] == 1 + 3 / 4 + 15 / 16


KINDS: dict[str, tuple[Any, dict[str, Any]]] = {
    "equal": (EQUAL, {}),
    "every arrival": (EQUAL, {"decide_at": "arrival"}),
    "sizes": (SIZES, {"reference": "afr"}),
    "bytes": (SIZES, {"max_bytes": 600_000, "candidates": 3}),
    "bytes, every arrival": (SIZES, {"max_bytes": 600_000, "decide_at": "arrival", "reference": "price-dp"}),
    "slots": (SIZES, {"actions": "slots", "reference": "codel"}),
    "dead link": (DEAD, {"reference": "random"}),
    "held": (EQUAL, {"repeat": 3, "reference": "target-gap"}),
    "a rule that remembers": (EQUAL, {"reference": "learned"}),
    "own V": (SuiteScenario("interruption-v1"), {"reference": "drop-newest"}),
}
L = 4


@kernels
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [12, pytest.param(1000, marks=pytest.mark.nightly)])
def test_an_episode_sums_to_its_qoi_less_a_constant_or_less_the_qoi_of_the_rule(kind: str, n: int) -> None:
    """The constants: 1 and the sum of V over all steps in x, added up here; the rule's H in a run of its own."""
    scenario, options = KINDS[kind]
    envs = SenderVectorEnv(n, scenario, L, reward=BOTH, autoreset_mode="Disabled", **options)
    episodes = [draw(scenario, seed) for seed in range(n)]
    info = envs.reset(options={"episodes": episodes})[1]
    rng, sums, qois, over = np.random.default_rng(0), np.zeros((2, n)), np.zeros(n), np.zeros(n, np.bool_)
    rule = policies.get(options.get("reference", "min-motion-gap"))
    while not over.all():
        chosen = (rng.random(info["action_mask"].shape) * info["action_mask"]).argmax(axis=1)
        envs.sub_envs.step(chosen)
        info = {"action_mask": envs.sub_envs.output.action_mask}
        terms = np.stack([envs.sub_envs.output.reward_terms[:, -2], envs.sub_envs.output.reward_terms[:, -1]])
        assert envs.sub_envs.rewards() == pytest.approx(terms.sum(0), abs=1e-12)
        assert (terms[:, over] == 0).all()  # after its end a row earns nothing
        sums += terms
        over = over | envs.sub_envs.output.terminated
    qois = np.maximum(envs.sub_envs.output.qoi, 1.0)
    values = [episode.value or scenario.value for episode in episodes]
    limits: dict[str, Any] = {"max_bytes": options.get("max_bytes")}
    for i, (episode, v) in enumerate(zip(episodes, values, strict=True)):
        x = episode.arrivals["x"]
        constant = 1 + sum(float(v.information(np.array([0.0, d]))) - 1 for d in np.diff(x))
        of_rule = max(outcome(run(rule, [episode], L, v, **limits), 0).qoi, 1.0)
        assert sums[0, i] == pytest.approx(qois[i] - constant, abs=1e-9)
        assert sums[1, i] == pytest.approx(qois[i] - of_rule, abs=1e-9)


def test_who_does_as_the_rule_does_has_nothing_more_at_any_step() -> None:
    """The cheapest candidate is min-motion-gap, so action 0 always earns 0: with the bytes' limit as without it."""
    for options in ({}, {"decide_at": "arrival"}):
        env = SenderEnv(EQUAL, L, reward="paired", **options)
        for seed in range(3):
            env.reset(seed=seed)
            rewards, ended = [], False
            while not ended:
                _, reward, ended, *_ = env.step(0)
                rewards.append(reward)
            assert len(rewards) > 5 and np.abs(rewards).max() < 1e-12


@kernels
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("more", [{}, {"repeat": 3}, {"num_threads": 2}])
def test_a_row_is_the_single_environment(mode: str, more: dict[str, Any]) -> None:
    """Bit for bit, over ends and truncations, whatever the rows beside it do."""
    options: dict[str, Any] = {"reward": {**BOTH, "energy": 0.1}, "reference": "random", **more}
    envs = SenderVectorEnv(3, SIZES, L, autoreset_mode=mode, max_episode_steps=9, **options)
    own = gym.wrappers.TimeLimit(SenderEnv(SIZES, L, **{**options, "num_threads": 1}), 9)
    seen, one, over, ends = envs.reset(seed=5)[0], own.reset(seed=6)[0], False, 0
    mine: Any = 0.0
    rng = np.random.default_rng(0)
    for _ in range(60):
        assert np.array_equal(seen[1], one)
        actions = rng.integers(3, size=3)
        seen, reward, terminated, truncated, _ = envs.step(actions)
        if over and mode == "NextStep":
            (one, _), mine, ended, cut = own.reset(), 0.0, False, False
        else:
            one, mine, ended, cut, _ = own.step(actions[1])
        assert (reward[1], terminated[1], truncated[1]) == (mine, ended, cut)
        over = ended or cut
        ends += over
        if over and mode == "SameStep":
            one, _ = own.reset()
    assert ends > 3


@kernels
@pytest.mark.parametrize("options", [{}, {"decide_at": "arrival"}, {"max_bytes": 600_000}])
def test_an_action_that_holds_is_the_same_place_of_each_decision_in_turn(options: dict[str, Any]) -> None:
    """Three single decisions, as far as the episode has them, have the rewards of one that holds for three."""
    options = {**options, "reward": {**BOTH, "delivered": 0.5}}
    held, single = SenderEnv(SIZES, L, repeat=3, **options), SenderEnv(SIZES, L, **options)
    rng, cut = np.random.default_rng(0), 0
    for seed in range(6):
        assert np.array_equal(held.reset(seed=seed)[0], single.reset(seed=seed)[0])
        ended = False
        while not ended:
            action, total, over, decisions = int(rng.integers(3)), 0.0, False, 0
            seen, reward, ended, _, info = held.step(action)
            while decisions < 3 and not over:
                one, more, over, _, last = single.step(action)
                total, decisions = total + more, decisions + 1
            cut += decisions < 3
            assert ended == over and np.array_equal(seen, one) and info["qoi"] == last["qoi"]
            assert reward == pytest.approx(total, abs=1e-9)
    assert cut > 0  # an episode ended while an action held


def test_a_copy_goes_on_by_itself() -> None:
    env = SenderEnv(SIZES, L, reward="paired", reference="afr")
    env.reset(seed=0)
    env.step(1)
    other = copy.deepcopy(env)
    first = [env.step(2)[1] for _ in range(6)]
    assert first == [other.step(2)[1] for _ in range(6)]


@kernel
def halved(x: float) -> float:
    return x / 2


def test_a_copied_rule_finds_its_code_anew() -> None:
    assert halved(3.0) == copy.deepcopy(halved)(3.0) == 1.5


GOES_ON = """
import pickle, sys
env = pickle.load(open(sys.argv[1], "rb"))
print([env.step(2)[1] for _ in range(6)])
"""


def test_a_copy_goes_on_in_another_process(tmp_path: Path) -> None:
    """There the rule's functions have other addresses."""
    env = SenderEnv("lte", L, reward="paired", reference="gap-price")
    env.reset(seed=0)
    env.step(1)
    (tmp_path / "env").write_bytes(pickle.dumps(env))
    done = subprocess.run(
        [sys.executable, "-c", GOES_ON, tmp_path / "env"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [env.step(2)[1] for _ in range(6)]


def test_robots_of_a_cell_learn_from_their_cost() -> None:
    """Each robot's cost sums to its H - 1 less its constant, though they share a link."""
    rows = FleetVecEnv(2, 3, SIZES, L, term="cost", reward="own", actions="candidates", autoreset_mode="SameStep")
    rows.reset(seed=0)
    episodes, total = rows.sub_envs.senders.episodes, np.zeros(6)
    constants = [SIZES.value.information(episode.arrivals["x"]) for episode in episodes if episode is not None]
    over = np.zeros(6, np.bool_)
    while not over.all():
        _, reward, ended, _, info = rows.step(np.random.default_rng(1).integers(3, size=6))
        total[~over] += reward[~over]
        if ended.any():
            new = ended & ~over
            assert total[new] == pytest.approx(info["final_info"]["qoi"][new] - np.array(constants)[new], abs=1e-9)
            over |= ended


def test_the_default_reward() -> None:
    """``paired`` where each queue has a link of its own: always the cheapest earns 0. Elsewhere ``retained``."""
    alone = SenderEnv(EQUAL, L)
    alone.reset(seed=0)
    rewards, ended = [], False
    while not ended:
        _, reward, ended, _, info = alone.step(0)
        rewards.append(reward)
    assert rewards == [0] * len(rewards) and info["reward_terms"]["paired"] == 0
    others: Any = (gym.make("bufgym/Topics-v0"), FleetVecEnv(1, 2, EQUAL, L, reward="own", autoreset_mode="SameStep"))
    for env in others:
        env.reset(seed=0)
        _, reward, _, _, info = env.step(env.action_space.sample() * 0)
        assert np.array_equal(reward, info["reward_terms"]["retained"]) and "paired" not in info["reward_terms"]


@pytest.mark.parametrize("name", ["Uplink", "Interruption", "Suite"])
def test_the_version_before_differs_in_its_reward_alone(name: str) -> None:
    with pytest.warns(DeprecationWarning, match="upgrading to version `v1`"):
        before = gym.make(f"bufgym/{name}-v0")
    now = gym.make(f"bufgym/{name}-v1")
    assert np.array_equal(before.reset(seed=3)[0], now.reset(seed=3)[0])
    for action in (0, 1, 2, 1):
        seen, reward, ended, _, info = before.step(action)
        assert np.array_equal(seen, now.step(action)[0]) and reward == info["reward_terms"]["retained"]
        if ended:
            break


PLAIN = policies.Policy("plain-python", lambda buffer, arrival, memory: policies.ACCEPT)
test_wrong_use = refused(
    (lambda: SenderEnv("lte", reward="paired", reference="afrr"), "unknown policy 'afrr'"),
    (lambda: SenderEnv("lte", reward="paired", reference=PLAIN), "'plain-python' runs as plain Python"),
    (lambda: SenderEnv("lte", reward="paired", reference="clairvoyant"), "none that a robot could have instead"),
    (lambda: SenderEnv("lte", repeat=0), "repeat = 0: must be a whole number"),
    (lambda: SenderEnv("lte", repeat=2, actions="slots"), "repeat = 2: for candidates"),
    (lambda: gym.make("bufgym/Topics-v0", repeat=2), "repeat = 2: for "),
    (lambda: gym.make("bufgym/Topics-v0", reward="cost"), "'cost' is for one queue"),
    (lambda: FleetVecEnv(term="paired"), "term 'paired': known for one queue on a link of its own"),
    (lambda: FleetVecEnv(repeat=2, actions="candidates"), "repeat = 2: for one queue on a link of its own"),
)

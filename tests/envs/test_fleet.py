"""Fleet environments: that they are the rows and rollouts that are tested elsewhere."""

import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import same, valid_action
from gymnasium.vector import AutoresetMode
from needs import needs
from refusal_cases import refuse, refused

from bufgym import policies
from bufgym.envs import FleetVecEnv, SenderEnv
from bufgym.model.link import Link
from bufgym.model.observe import CONTEXT_FIELDS, SLOT_FIELDS
from bufgym.scenario import FleetEpisode, FleetScenario, Streams, messages
from bufgym.sim.cell import run_fleet
from bufgym.traces import Trace

pytest.importorskip("pettingzoo", reason=needs("extras", "pettingzoo"))

from bufgym.envs import FleetEnv

L = 4
SMALL: dict[str, Any] = {"capacity": L, "duration_s": 2.0, "size_bytes": 600_000}
PARAMETERS = {"duration_s": 2.0, "size_bytes": 600_000}


@pytest.mark.parametrize("actions", [{"actions": "slots"}, {"actions": "candidates", "candidates": 3}])
def test_one_robot_is_the_single_environment(actions):
    fleet, single = FleetEnv(robots=1, **SMALL, **actions), SenderEnv(reward="retained", **SMALL, **actions)
    assert fleet.action_space("robot_0") == single.action_space
    rng = np.random.default_rng(0)
    seen, infos = fleet.reset(seed=3)
    alone, info = single.reset(seed=3)
    terminated = False
    while not terminated:
        np.testing.assert_equal(seen["robot_0"], alone)
        assert np.array_equal(infos["robot_0"]["action_mask"], info["action_mask"])
        action = valid_action(info["action_mask"], rng)
        seen, rewards, ended, _, infos = fleet.step({"robot_0": action})
        alone, reward, terminated, _, info = single.step(action)
        assert rewards == {"robot_0": reward}
        assert ended == {"robot_0": terminated}
    assert infos["robot_0"].keys() == info.keys()
    assert all(infos["robot_0"][name] == info[name] for name in ("qoi", "arrived", "delivered", "dropped"))


def test_the_cheapest_candidate_is_what_the_rule_drops():
    """Robots that always take candidate 0 decide as min-motion-gap does: of frames of one size the gap alone counts."""
    scenario = FleetScenario.of(3, "lte", **PARAMETERS)
    episode = scenario.draw(Streams.seeded(1))
    env = FleetEnv(3, scenario, L, actions="candidates")
    _, infos = env.reset(options={"episode": episode})
    low, high = env.state_space.low, env.state_space.high
    while env.agents:
        assert ((low <= env.state()) & (env.state() <= high)).all()
        _, _, _, _, infos = env.step(dict.fromkeys(env.agents, 0))
    fleet = run_fleet(policies.get("min-motion-gap"), [episode], L, scenario.value)
    h = fleet.senders.batch.senders["delivered_gain"] + 1
    assert [infos[agent]["qoi"] for agent in env.possible_agents] == pytest.approx(h.tolist())
    assert all(infos[agent]["dropped"] > 0 for agent in env.possible_agents)


@pytest.mark.parametrize("reward", ["team", "own"])
def test_an_episode_is_the_rollout_of_the_same_policy(reward):
    # All robots decide at once, from what each saw before the others did; the rollout asks one after the other.
    scenario = FleetScenario.of(5, "lte", **PARAMETERS)
    episode = scenario.draw(Streams.seeded(1))
    env = FleetEnv(5, scenario, L, reward=reward, term="delivered")
    _, infos = env.reset(options={"episode": episode})
    sums = dict.fromkeys(env.agents, 0.0)
    own = dict.fromkeys(env.agents, 0.0)
    ticks = 0
    while env.agents:
        # What drop-oldest does: accept where there is room, else evict slot 0.
        actions = {agent: L + 1 if infos[agent]["action_mask"][L + 1] else 0 for agent in env.agents}
        _, rewards, _, truncated, infos = env.step(actions)
        ticks += 1
        for agent, rewarded in rewards.items():
            sums[agent] += rewarded
            own[agent] += infos[agent]["reward_terms"]["delivered"]
            assert not truncated[agent]
    assert ticks == scenario.max_messages
    fleet = run_fleet(policies.get("drop-oldest"), [episode], L, scenario.value)
    assert (np.asarray(env.sub_envs.senders.batch.log) == np.asarray(fleet.senders.batch.log)).all()
    for agent in env.possible_agents:
        assert infos[agent]["qoi"] == pytest.approx(1 + own[agent])
        assert infos[agent]["arrived"] == infos[agent]["delivered"] + infos[agent]["dropped"]
        assert sums[agent] == pytest.approx(np.mean(list(own.values())) if reward == "team" else own[agent])
    assert len({round(total, 6) for total in own.values()}) > 1  # they moved differently
    with pytest.raises(gym.error.ResetNeeded):
        env.step({})


def test_what_a_step_hands_out_is_never_written_again():
    env, held, copies = FleetEnv(robots=2, **SMALL), [], []
    seen, _ = env.reset(seed=0)
    while env.agents:
        for agent in env.agents:
            assert env.observation_space(agent).contains(seen[agent])
            held.append(seen[agent])
            copies.append({name: array.copy() for name, array in seen[agent].items()})
        seen, *_ = env.step(dict.fromkeys(env.agents, L + 1))
    assert len(held) > 2 and all(same(now, then) for now, then in zip(held, copies, strict=True))


def test_np_random_is_the_generator_of_the_seed():
    """As SuperSuit's frame_skip draws from it, without a seed too."""
    env = FleetEnv(robots=2, **SMALL)
    assert 1 <= env.np_random.integers(1, 5) < 5
    drawn = []
    for _ in range(2):
        seen, _ = env.reset(seed=6)
        drawn.append(
            (env.np_random.random(), seen["robot_1"]["loss"].tolist(), env.reset()[0]["robot_1"]["size"].tolist())
        )
    assert drawn[0] == drawn[1]


def test_fields_and_state():
    env = FleetEnv(robots=3, fields=["occupancy", "loss"], **SMALL)
    seen, _ = env.reset(seed=0)
    assert env.state().shape == (3 * (len(SLOT_FIELDS) * (L + 1) + len(CONTEXT_FIELDS)),)
    assert env.state_space.contains(env.state())
    assert set(seen["robot_2"]) == {"occupancy", "loss"}
    assert env.observation_space("robot_2").contains(seen["robot_2"])


def test_pictures_have_a_line_and_a_bar_for_every_robot():
    env, image = FleetEnv(robots=3, render_mode="ansi", **SMALL), FleetEnv(robots=60, render_mode="rgb_array", **SMALL)
    with pytest.raises(gym.error.ResetNeeded):
        env.render()
    env.reset(seed=0), image.reset(seed=0)
    shown = [image.render()]
    for _ in range(8):
        env.step(dict.fromkeys(env.agents, L + 1)), image.step(dict.fromkeys(image.agents, L + 1))
    head, *lines = env.render().splitlines()
    assert head.endswith("of 3 sending")
    assert [line.split()[0] for line in lines] == env.possible_agents
    queued = env.sub_envs.senders.batch.senders[1]["occupancy"]
    assert (lines[1].count("■"), lines[1].count("·")) == (queued, L - queued)
    shown.append(image.render())
    assert all(frame.shape == (400, 800, 3) and frame.dtype == np.uint8 for frame in shown)
    before, after = (int((frame == (0xE0, 0xA1, 0x00)).all(axis=-1).sum()) for frame in shown)
    assert after > before + 500  # the legend has the colour, too
    assert (image.sub_envs.senders.batch.senders["next"] == 8).all()  # drawing changes nothing
    envs = FleetVecEnv(1, 2, "lte", L, **PARAMETERS, render_mode="rgb_array")
    envs.reset(seed=0)
    assert [frame.shape for frame in envs.render()] == [(400, 800, 3)] * 2
    with pytest.warns(UserWarning, match="render_mode"):
        assert FleetEnv(robots=3, **SMALL).render() is None


test_bad_input_is_told_apart = refused(
    (lambda: FleetEnv(reward="all"), "reward = 'all': must be 'team'"),
    (lambda: FleetEnv(term="speed"), "unknown term 'speed'"),
    (lambda: FleetVecEnv(actions="candidates", term="regret"), "term 'regret': .*, not for a cell of robots"),
    (lambda: FleetEnv(bound=True), "bound = True: .*, not for a cell of robots"),
    (lambda: FleetVecEnv(frameskip=1), "unexpected keyword argument 'frameskip'", TypeError),
    (lambda: begun().step({"robot_0": 0, "robot_1": 1.7}), r"actions\['robot_1'\] = 1.7: must be a whole number"),
    (lambda: begun().step({"robot_0": 0}), "actions: none for 'robot_1'"),
    (
        lambda: begun().step({"robot_0": 0, "robot_1": L + 2}),
        r"actions\['robot_1'\] = 6: must be a whole number in 0..5",
    ),
    (lambda: begun().reset(options={"episode": apart()}), "arrive at the same times"),
    (lambda: begun().reset(options={"episode": 3}), "3 is not a bufgym.scenario FleetEpisode"),
    (lambda: FleetVecEnv(0), "cells = 0"),
    (lambda: FleetVecEnv(2, 2).reset(options={"episodes": [None]}), "1 given for 2 cells"),
    (lambda: batch().reset(options={"reset_mask": np.arange(4) == 0}), "begin together"),
)


def begun():
    env = FleetEnv(robots=2, **SMALL)
    env.reset(seed=0)
    return env


def apart(robots=2):
    """Robots whose frames come one after the other."""
    link = Link(Trace("even", np.array([0, 1_000_000]), np.array([0, 1_000_000])))
    return FleetEpisode(tuple(messages(np.array([i, 10 + i]), 5) for i in range(robots)), link)


def batch():
    envs = FleetVecEnv(2, 2, **PARAMETERS)
    envs.reset(seed=0)
    return envs


def test_without_pettingzoo_the_error_names_the_extra(monkeypatch):
    import bufgym.envs

    monkeypatch.delattr(bufgym.envs, "fleet", raising=False)
    for name in list(sys.modules):
        if name == "bufgym.envs.fleet" or name.split(".")[0] == "pettingzoo":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    refuse(r'FleetEnv needs pettingzoo: pip install "bufgym\[fleet\]"', bufgym.envs.__getattr__, "FleetEnv")
    with pytest.raises(AttributeError, match="no_such_thing"):
        bufgym.envs.__getattr__("no_such_thing")
    assert bufgym.envs.FleetVecEnv is FleetVecEnv


@pytest.mark.parametrize("reward", ["team", "own"])
def test_rows_of_the_batch_are_the_robots_of_the_fleets(reward):
    cells, robots = 2, 3
    envs = FleetVecEnv(cells, robots, "lte", L, reward=reward, num_threads=2, **PARAMETERS)
    fleets = [FleetEnv(robots, "lte", L, reward=reward, **PARAMETERS) for _ in range(cells)]
    seen, info = envs.reset(seed=11)
    each = [fleet.reset(seed=11 + c * robots) for c, fleet in enumerate(fleets)]
    rng = np.random.default_rng(0)
    assert envs.num_envs == 6
    for _ in range(60):
        actions = np.array([valid_action(mask, rng) for mask in info["action_mask"]])
        for c, (observation, infos) in enumerate(each):
            for r, agent in enumerate(fleets[c].possible_agents):
                i = c * robots + r
                assert np.array_equal(info["action_mask"][i], infos[agent]["action_mask"])
                assert all(np.array_equal(seen[key][i], observation[agent][key]) for key in seen)
        seen, rewards, terminated, truncated, info = envs.step(actions)
        each = []
        for c, fleet in enumerate(fleets):
            mine = dict(zip(fleet.possible_agents, actions[c * robots : (c + 1) * robots].tolist(), strict=True))
            observation, rewarded, ended, _, infos = fleet.step(mine)
            each.append((observation, infos))
            assert rewards[c * robots : (c + 1) * robots].tolist() == list(rewarded.values())
            assert terminated[c * robots : (c + 1) * robots].tolist() == list(ended.values())
        assert not truncated.any()
    assert terminated.all()
    assert info["qoi"].tolist() == [each[c][1][f"robot_{r}"]["qoi"] for c in range(2) for r in range(3)]
    # The next step begins the next episode of each cell's streams.
    seen, rewards, *_ = envs.step(np.zeros(6, np.int64))
    again = [fleet.reset()[0] for fleet in fleets]
    assert not rewards.any()
    assert all(np.array_equal(seen[key][4], again[1]["robot_1"][key]) for key in seen)


def test_cells_can_be_given_and_begun_one_by_one():
    envs = FleetVecEnv(2, 2, "lte", L, autoreset_mode=AutoresetMode.DISABLED, **PARAMETERS)
    given = FleetScenario.of(2, "lte", **PARAMETERS).draw(Streams.seeded(4))
    envs.reset(seed=0, options={"episodes": [None, given]})
    assert envs.sub_envs.senders.episodes[3].arrivals is given.arrivals[1]
    for _ in range(10):
        envs.step(np.full(4, L + 1))
    envs.reset(options={"reset_mask": np.array([False, False, True, True]), "episodes": [None, given]})
    assert envs.sub_envs.senders.batch.senders["next"].tolist() == [10, 10, 0, 0]


@pytest.mark.kernels
def test_a_robot_that_is_asked_again_holds_the_others_up():
    # B = 2500. Robot 0: 1000, 1000 and 500 are queued behind its first message, then 2000 comes: both of the oldest go.
    # Robot 1's last message, 3000, is larger than B: it is dropped unasked.
    arrivals = [messages(np.arange(5), np.array(s)) for s in ([100, 1_000, 1_000, 500, 2_000], [100] * 4 + [3_000])]
    link = Link(Trace("slow", np.array([0, 1_000_000, 2_000_000]), np.array([0, 10, 1_000_000]), "hold"))
    episode = FleetEpisode((arrivals[0], arrivals[1]), link)
    env = FleetEnv(2, FleetScenario.of(2, "lte"), 8, max_bytes=2_500)
    seen, infos = env.reset(options={"episode": episode})
    steps = []
    while env.agents:
        due = [infos[agent]["action_mask"].sum() > 1 for agent in env.agents]
        steps.append((*due, *(int(8 * seen[agent]["occupancy"][0]) for agent in env.agents)))
        actions = {a: 9 if (mask := infos[a]["action_mask"])[9] else 0 if mask[0] else 8 for a in env.agents}
        seen, _, _, _, infos = env.step(actions)
    # (is robot 0 asked, is robot 1, messages queued at either)
    assert steps[:4] == [(True, True, 0, 0), (True, True, 0, 0), (True, True, 1, 1), (True, True, 2, 2)]
    assert steps[4:] == [(True, False, 3, 0), (True, False, 2, 0)]
    assert all(infos[agent]["invalid"] == 0 for agent in infos)
    rollout = run_fleet(policies.get("drop-oldest"), [episode], 8, FleetScenario.of(2, "lte").value, max_bytes=2_500)
    assert (np.asarray(env.sub_envs.senders.batch.log)[:, :5] == np.asarray(rollout.senders.batch.log)).all()

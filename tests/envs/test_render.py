"""Pictures of an episode: what they say, that they change nothing, and that no odd case breaks them."""

import re
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import SMALL, text

import bufgym
from bufgym.envs import SenderEnv, SenderVectorEnv, render
from bufgym.envs.render import scene
from bufgym.model.link import Link
from bufgym.scenario import Episode, Interruption, Uplink, messages
from bufgym.traces import Trace


def test_a_frame_of_text_by_hand() -> None:
    """T = 6, L = 2: 1 and 2 are accepted, 3 evicts 1, 4 is rejected, and 5 waits."""
    env = SenderEnv(Interruption(law="fixed", t_max=6), 2, render_mode="ansi", actions="slots")
    env.reset(seed=0)
    for action in (3, 3, 0, 2):
        env.step(action)
    counts, *rest = text(env)
    assert "5 arrived: 0 delivered, 1 in transmission, 2/2 queued, 2 dropped; H = 0.00" in counts
    assert [line.split()[1:] for line in rest[:3]] == [["______"], ["▶·■■·?"], [*"▶1■■1?"]]
    for _ in range(2):
        env.step(2)
    counts, *rest = text(env)
    assert "8 arrived: 4 delivered, 0 in transmission, 0/2 queued, 4 dropped; H = 2.8" in counts
    assert [line.split()[1:] for line in rest[:3]] == [["______██"], ["●·●●···●"], [*"●__"]]


def test_a_frame_says_what_each_action_drops() -> None:
    """T = 6, L = 2, all gaps are 1: dropping 1, 2 or the newcomer leaves a gap of 2, and ties go to the older."""
    env = SenderEnv(Interruption(law="fixed", t_max=6), 2, render_mode="ansi", candidates=3)
    assert env.reset(seed=0)[1]["slots"].tolist() == [0, 1, 2, 0]
    actions = "0 drops slot 0, 1 drops slot 1, 2 rejects the newcomer"
    assert f"actions   {actions}" in env.render()
    asked_always = SenderEnv(Interruption(law="fixed", t_max=6), 2, render_mode="ansi", decide_at="arrival")
    asked_always.reset(seed=0)
    assert "0 accepts the newcomer" in asked_always.render()


@pytest.mark.parametrize("env_id", bufgym.ENVIRONMENTS)
def test_every_environment_draws_itself_in_both_modes(env_id: str) -> None:
    smaller = SMALL[env_id] | {"actions": "slots"} | ({"law": "fixed"} if "Interruption" in env_id else {})
    for mode in ("ansi", "rgb_array"):
        env = gym.make(env_id, render_mode=mode, **smaller)
        plain = gym.make(env_id, **smaller)
        env.reset(seed=1), plain.reset(seed=1)
        ended, k = False, 0
        while not ended:
            if k in (0, 8):
                check(env.render(), mode)
            _, reward, ended, _, info = env.step(k % 10)
            _, reward_unseen, ended_unseen, _, info_unseen = plain.step(k % 10)
            assert (reward, ended) == (reward_unseen, ended_unseen)  # drawing changes nothing
            assert (info["action_mask"] == info_unseen["action_mask"]).all()
            k += 1
        check(env.render(), mode)


def check(frame: Any, mode: str) -> None:
    if mode == "ansi":
        lines = re.sub(r"\x1b\[[0-9;]*m", "", frame).splitlines()
        topics = sum(line[1:2] == " " and line[:1].isalpha() for line in lines)  # a lane each
        assert 5 <= len(lines) - max(0, topics - 1) <= 6
        assert max(map(len, lines)) <= 100
    else:
        assert frame.shape == (400, 800, 3)
        assert frame.dtype == np.uint8
        assert frame.std() > 5


def test_image_shows_each_state_in_its_colour() -> None:
    env = SenderEnv(Interruption(law="fixed", t_max=30), 3, render_mode="rgb_array", actions="slots")
    env.reset(seed=0)
    for action in (4, 4, 4, 0, 0):
        env.step(action)
    image = env.render()
    shown = {tuple(pixel) for pixel in image.reshape(-1, 3).tolist()}
    colour = [tuple(int(c[k : k + 2], 16) for k in (1, 3, 5)) for c in render.image.COLOURS]
    assert {colour[state] for state in (scene.QUEUED, scene.SENDING, scene.NEWCOMER, scene.DROPPED)} <= shown
    assert tuple(image[2, 2]) == (255, 255, 255)


@pytest.mark.parametrize("capacity", [1, 20, 40, 300])
def test_lines_keep_to_the_width(capacity: int) -> None:
    n = 100
    env = SenderEnv(Interruption(law="fixed", t_max=n + 5), capacity, actions="slots")
    env.reset(seed=0)
    for k in range(n):
        env.step(capacity + 1 if k % 3 else capacity)
    lines = text(env)
    assert max(map(len, lines[1:4])) <= 100
    assert lines[3].endswith("?")
    check(render.rgb_array(env.sub_envs.senders, 0), "rgb_array")


@pytest.mark.parametrize("arrivals_us", [[0], [0, 0, 0], [5, 10**9]])
def test_odd_episodes(arrivals_us: list[int]) -> None:
    """A single message, all at one moment, and a quarter of an hour of nothing; on a link that dies."""
    episode = Episode(messages(np.array(arrivals_us), 200), Link(Trace.steps([(1.0, 300.0)], after="stop")))
    env = SenderEnv(Interruption(t_max=20), 2, actions="slots")
    env.reset(options={"episode": episode})
    ended = False
    while True:
        assert len(text(env)) >= 5
        check(render.rgb_array(env.sub_envs.senders, 0), "rgb_array")
        if ended:
            break
        ended = env.step(2)[2]


def test_each_row_of_a_batch_is_drawn() -> None:
    trace = Trace.steps([(0.5, 9e6), (0.5, 1e5)])
    envs = SenderVectorEnv(2, Uplink(traces=(trace,), duration_s=1.0), 3, render_mode="ansi", actions="slots")
    alone = SenderEnv(Uplink(traces=(trace,), duration_s=1.0), 3, render_mode="ansi", actions="slots")
    envs.reset(seed=4), alone.reset(seed=5)
    for _ in range(9):
        envs.step(np.array([4, 4])), alone.step(4)
    assert envs.render()[1] == alone.render()
    envs.render_mode = "rgb_array"
    assert [frame.shape for frame in envs.render()] == [(400, 800, 3)] * 2


def test_before_the_reset_and_without_a_mode() -> None:
    for mode in ("ansi", "rgb_array"):
        with pytest.raises(gym.error.ResetNeeded):
            SenderEnv(render_mode=mode, actions="slots").render()
    with pytest.warns(UserWarning, match="render_mode"):
        assert SenderEnv(actions="slots").render() is None


def test_images_without_matplotlib_say_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    env = SenderEnv("interruption", render_mode="rgb_array", actions="slots")
    env.reset(seed=0)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(gym.error.DependencyNotInstalled, match=r"bufgym\[plot\]"):
        env.render()

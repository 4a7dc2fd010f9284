"""``bufgym/Topics-v0``: two kinds of event, worked by hand, on copies of the sender, and in Gymnasium's forms."""

from typing import Any

import numpy as np
import pytest
from env_cases import LINKS, client, text, valid_action
from refusal_cases import refuse

from bufgym.envs import SenderEnv, render
from bufgym.envs.render import scene
from bufgym.jit import JIT
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.observe import REWARD_TERMS, TOPIC_REWARD_TERMS
from bufgym.model.topics import Topic
from bufgym.scenario import Client, Episode, Stream, messages
from bufgym.sim.decisions import answer_send
from bufgym.sim.metrics import topic_outcomes
from bufgym.sim.state import ARRIVAL_WAITS, SOCKET_WAITS
from bufgym.traces import Trace

TERMS = [term.name for term in REWARD_TERMS + TOPIC_REWARD_TERMS]
L = 5
CLIENT = client(duration_s=2.0 if JIT else 1.0, scale=2.0)
CASES: dict[str, dict[str, Any]] = {"plain": {}, "bytes": {"max_bytes": 9_000}}
CASES |= {"window": {"window": 3, "round_trip_us": 30_000}, "overflow": {"decide_at": "overflow"}}


def make(case: str = "plain", capacity: int = L, **more: Any) -> SenderEnv:
    return SenderEnv(CLIENT, capacity, **(CASES[case] | more), actions="slots")


def waiting(env: SenderEnv) -> int:
    """Who asks: nobody (0), an arrival, or the socket."""
    return int(env.sub_envs.senders.batch.senders["waiting"][0])


def test_fields_of_topics_need_topics() -> None:
    seen, _ = make(fields=["silence", "socket_asks"]).reset(seed=3)
    assert (seen["silence"].shape, seen["socket_asks"].shape) == ((L + 1,), (1,))
    refuse("unknown field 'silence'", SenderEnv, "lte", fields=["silence"])
    # The terms of topics have namesakes there, computed where they are named.
    assert [term.name for term in SenderEnv("lte", reward="age", actions="slots").sub_envs.terms] == [
        "delivered",
        "retained",
        "age",
    ]


V = qoi.saturating(4)
THREE = (
    Stream(Topic("pose", priority=4, weight=2, deadline_s=0.01), 10, 100),
    Stream(Topic("image", priority=1, weight=1, value=qoi.saturating(8)), 10, 100),
    Stream(Topic("command", priority=2, weight=0.5, no_drop=True), 10, 100),
)
BY_HAND = Client(THREE, LINKS[0], value=V)
"""Weights 2, 1 and 0.5; V is d / 4, of images d / 8, up to 1."""


def three_topics(**more: Any) -> Episode:
    """Seven messages of 100 bytes over 10 bytes/ms: each takes 10 ms.

    0 pose at 0 ms, 1 image at 1, 2 command at 2, 3 pose at 4, 4 image at 6, 5 pose at 8, 6 command at 9. x = ms.
    """
    ms = np.array([0, 1, 2, 4, 6, 8, 9])
    arrivals = messages(1_000 * ms, np.full(7, 100), ms.astype(float))
    arrivals["topic"] = [0, 1, 2, 0, 1, 0, 2]
    steady = Trace("steady", np.array([0, 1_000_000]), np.array([0, 10_000]))
    return Episode(arrivals, Link(steady, propagation_us=1_000), **more)


@pytest.mark.kernels
def test_an_episode_of_three_topics_by_hand() -> None:
    """L = 3. Accept 0, which is asked for and sent at once; accept 1, 2 and 3; 4 comes: the queue is full.

    4 (image) evicts 1 (image); 5 (pose) is rejected; 6 (command) can't be: it evicts 3 (pose). Queued are 2 4 6. At
    10 ms 0 has crossed and the socket asks. It sends 4, at 20 ms 2, at 30 ms 6, and all have crossed at 40 ms.
    """
    env = SenderEnv(BY_HAND, 3, reward={"retained": 1.0, "age": 1.0, "late": 10.0}, actions="slots")
    accept, reject = 4, 3
    script = [
        # who asks, at what time, which actions are valid, action, retained, delivered
        (ARRIVAL_WAITS, 0, [0, 0, 0, 1, 1], accept, 0, 0),
        (SOCKET_WAITS, 0, [1, 0, 0, 1, 0], 0, 0, 0),
        (ARRIVAL_WAITS, 1, [0, 0, 0, 1, 1], accept, 0, 0),  # the first image: the 1 in its H
        (ARRIVAL_WAITS, 2, [1, 0, 0, 0, 1], accept, 0, 0),  # the first command; there is room, so not to be rejected
        (ARRIVAL_WAITS, 4, [1, 0, 0, 1, 1], accept, 2 * 4 / 4, 0),  # pose: weight 2, V(4) = 1
        (ARRIVAL_WAITS, 6, [1, 0, 1, 1, 0], 0, 0, 0),  # 4 is the first image now
        (ARRIVAL_WAITS, 8, [0, 1, 1, 1, 0], reject, 0, 0),  # queued 2 3 4: the command may not be evicted
        (ARRIVAL_WAITS, 9, [0, 1, 1, 0, 0], 1, -2 + 0.5 * 1, 0),  # 3 goes; command 2 -> 9: V(7) = 1, weight 0.5
        (SOCKET_WAITS, 10, [1, 1, 0, 0, 0], 1, 0, 0),  # 2 4 6: oldest of their topics are 2 and 4; nothing is to come
        (SOCKET_WAITS, 20, [1, 0, 0, 0, 0], 0, 0, 0),  # 2 before 6
        (SOCKET_WAITS, 30, [1, 0, 0, 0, 0], 0, 0, 0.5),
    ]
    seen, info = env.reset(options={"episode": three_topics()})
    totals = dict.fromkeys(TERMS, 0.0)
    for k, (who, ms, mask, action, retained, delivered) in enumerate(script):
        assert (waiting(env), int(env.sub_envs.senders.batch.senders["now_us"][0])) == (who, 1_000 * ms)
        assert info["action_mask"].tolist() == [bool(each) for each in mask]
        assert seen["socket_asks"] == [who == SOCKET_WAITS]
        assert seen["occupied"].tolist()[-1] == (who == ARRIVAL_WAITS)
        seen, _, ended, _, info = env.step(action)
        assert info["reward_terms"]["retained"] == pytest.approx(retained), k
        assert info["reward_terms"]["delivered"] == pytest.approx(delivered), k
        for name in TERMS:
            totals[name] += info["reward_terms"][name]
        assert ended == (k == len(script) - 1)
    assert info["invalid"] == 0
    assert (info["arrived"], info["delivered"], info["dropped"]) == (7, 4, 3)
    assert info["qoi"] == pytest.approx(2 + 1 + 0.5 * (1 + 1))
    assert totals["retained"] == totals["delivered"] == pytest.approx(0.5)
    # Ages until 9 ms, the last arrival, when nothing had been received: 9^2 / 2, 8^2 / 2 and 7^2 / 2 ms^2, weighted.
    assert totals["age"] == pytest.approx(-(2 * 81 / 2 + 64 / 2 + 0.5 * 49 / 2) / 3.5 * 1e-6)
    # Pose 0 came at 11 ms, 1 ms too late: 2 of 3.5.
    assert totals["late"] == pytest.approx(-2 / 3.5)
    assert not any(array.any() for array in seen.values())


@pytest.mark.kernels
def test_hold_waits_for_the_next_arrival_and_an_invalid_choice_sends_the_oldest() -> None:
    env = SenderEnv(BY_HAND, 3, actions="slots")
    env.reset(options={"episode": three_topics()})
    env.step(4)
    assert waiting(env) == SOCKET_WAITS
    _, _, _, _, info = env.step(3)  # hold
    assert (waiting(env), info["invalid"]) == (ARRIVAL_WAITS, 0)
    env.step(4)
    assert waiting(env) == SOCKET_WAITS  # asked anew: 0 and 1 are queued
    for action, invalid, goes in ((4, 1, 0), (2, 1, 0), (1, 0, 1), (0, 0, 0)):
        batch = env.sub_envs.senders.batch._replace(senders=env.sub_envs.senders.batch.senders.copy())
        answer_send(batch, 0, action)
        assert (batch.senders["invalid"][0], batch.senders["chosen"][0]) == (invalid, goes)


@pytest.mark.parametrize("case", CASES)
def test_rewards_add_up_to_the_outcome_under_random_play(case: str) -> None:
    """And observations lie in their space, also where many actions are invalid."""
    env, rng = make(case, reward={"delivered": 1.0, "retained": 2.0, "age": 3.0, "late": 4.0}), np.random.default_rng(1)
    weights = np.array([topic.share for topic in CLIENT.topics])
    for careless in (False, True):
        seen, info = env.reset(seed=7 + careless)
        ended, totals = False, dict.fromkeys(TERMS, 0.0)
        while not ended:
            assert env.observation_space.contains(seen) and info["action_mask"].any()
            action = int(rng.integers(L + 2)) if careless else valid_action(info["action_mask"], rng)
            seen, reward, ended, _, info = env.step(action)
            terms = info["reward_terms"]
            assert reward == pytest.approx(sum((i + 1) * terms[name] for i, name in enumerate(TERMS)))
            for name in TERMS:
                totals[name] += terms[name]
        assert (info["invalid"] > 0) == careless
        outcomes = topic_outcomes(env.sub_envs.senders, 0)
        assert info["qoi"] == pytest.approx(weights @ [made.qoi for made in outcomes])
        ones = weights @ [made.delivered > 0 for made in outcomes]
        assert totals["delivered"] == pytest.approx(info["qoi"] - ones, abs=1e-9)
        assert totals["retained"] == pytest.approx(info["qoi"] - ones, abs=1e-9)
        assert sum(made.limited for made in outcomes) > 0
        times = env.sub_envs.senders.episodes[0].arrivals
        first_us = [times["arrival_us"][times["topic"] == k][0] for k in range(4)]
        areas = [made.mean_age_s * (times["arrival_us"][-1] - first_us[k]) / 1e6 for k, made in enumerate(outcomes)]
        assert totals["age"] == pytest.approx(-(weights @ areas) / weights.sum())
        assert totals["late"] == pytest.approx(-(weights @ [made.late for made in outcomes]) / weights.sum())


def test_a_client_of_one_topic_without_weight_is_rewarded_nothing() -> None:
    """Its rules hold: two queued at most; both kinds of event."""
    stream = Stream(Topic("camera", priority=0.5, weight=0.0, deadline_s=0.05, limit=2), 20, 3_000)
    env = SenderEnv(Client((stream,), LINKS[:1], duration_s=2.0), 4, reward=dict.fromkeys(TERMS, 1.0), actions="slots")
    rng, (seen, info), ended, met = np.random.default_rng(0), env.reset(seed=1), False, set()
    assert seen["priority"][-1] == 1  # the largest of all
    while not ended:
        met.add(waiting(env))
        assert env.observation_space.contains(seen) and seen["occupied"][:4].sum() <= 2
        seen, reward, ended, _, info = env.step(valid_action(info["action_mask"], rng))
        assert reward == 0.0
    assert met == {ARRIVAL_WAITS, SOCKET_WAITS}
    assert info["invalid"] == 0 and 0 < info["dropped"] and info["qoi"] == 0 < info["delivered"]


def test_a_frame_of_text_has_a_lane_a_topic() -> None:
    """The episode by hand after 0 1 2 3 were accepted and 4 evicted 1: 0 is in transmission, 2 3 4 wait, 5 asks."""
    env = SenderEnv(BY_HAND, 3, actions="slots")
    env.reset(options={"episode": three_topics()})
    env.step(4)
    for action in (0, 4, 4, 4, 0):
        env.step(action)
    counts, _, pose, image, command, queue, *_ = text(env)
    assert "5 arrived: 0 delivered, 1 in transmission, 3/3 queued, 1 dropped; H = 0.00" in counts
    lane = len("a pose          ")
    assert [line[lane:] for line in (pose, image, command)] == ["▶  ■ ?", " ·  ■ ", "  ■   "]
    assert queue.split() == ["queue", "a", "c", "a", "b", "a"]


@pytest.mark.parametrize(("topics", "capacity"), [(2, 200), (8, 1), (30, 32)])
def test_pictures_of_any_size(topics: int, capacity: int) -> None:
    streams = tuple(Stream(Topic(f"a long name of topic {k}"), 5, 900) for k in range(topics))
    env = SenderEnv(Client(streams, LINKS[:1], duration_s=1.0), capacity, render_mode="rgb_array", actions="slots")
    env.reset(seed=0)
    for k in range(9):
        env.step(capacity + 1 if waiting(env) == ARRIVAL_WAITS else k % 2 * capacity)
        assert max(map(len, text(env)[1 : topics + 3])) <= 100
    frame = env.render()
    assert (frame.shape, frame.dtype) == ((400, 800, 3), np.uint8)
    shown = {tuple(pixel) for pixel in frame.reshape(-1, 3).tolist()}
    assert tuple(int(render.image.COLOURS[scene.QUEUED][k : k + 2], 16) for k in (1, 3, 5)) in shown
    assert tuple(frame[2, 2]) == (255, 255, 255)

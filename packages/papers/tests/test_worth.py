"""`bufgym/Mapping-v0`: its rewards are what the frames that arrived are worth."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from needs import needs

from bufgym.jit import JIT
from bufgym.utils.errors import BufgymError

pytest.importorskip("cv2", reason=needs("extras", "cv2"))
pytest.importorskip("rvl", reason=needs("extras", "rvl"))
from bufgym_papers.perception import streams, views, worth

pytestmark = pytest.mark.skipif(not JIT, reason=needs("compiled", "without compilation a room takes minutes to draw"))


def made(**settings: Any) -> Any:
    return gym.make("bufgym/Mapping-v0", **settings, actions="slots").unwrapped


def played(env: Any, action: int) -> tuple[list[float], dict[str, Any]]:
    """Rewards of an episode and its last info."""
    env.reset(seed=1)
    rewards, ended, info = [], False, {}
    while not ended:
        _, reward, ended, _, info = env.step(action)
        rewards.append(reward)
    return rewards, info


def test_frames_have_the_sizes_that_they_are_said_to_have() -> None:
    whole, sizes = worth.recording(), streams.between(worth.SIZES, worth.FRAMES)
    measured = {k: whole.size_bytes(k) for k in (120, 239)}
    assert measured == pytest.approx({k: int(sizes[k]) for k in measured}, rel=0.01)
    assert len(worth.SIZES) == len(streams.encoded(worth.FRAMES)) and sizes[5] == (sizes[0] + sizes[10]) // 2


def test_what_is_paid_comes_at_the_end() -> None:
    """Slot 0 goes where the queue is full: Drop Oldest. The terms are those of the frames which arrived."""
    env = made(reward={"covered": 1.0, "followed": 0.0, "tracked": 0.0})
    rewards, info = played(env, 0)
    terms = info["reward_terms"]
    assert not any(rewards[:-1]) and rewards[-1] == terms["covered"] > 0
    log = np.asarray(env.sub_envs.senders.batch.log[0])[: worth.FRAMES]
    kept = np.flatnonzero(log["transmitted_us"] >= 0)
    assert 20 < len(kept) < worth.FRAMES
    assert terms["covered"] == worth.scene().coverage.share(kept)
    assert terms["followed"] == views.least_overlap(worth.scene().seen, np.union1d(kept, [0, worth.FRAMES - 1]))
    assert 0 <= terms["tracked"] <= 1
    rewards, info = played(env, env.action_space.n - 2)  # rejects all: earns nothing
    assert info["delivered"] == 0 == info["reward_terms"]["covered"] == info["reward_terms"]["tracked"] == rewards[-1]


def test_its_terms_are_for_its_recording_alone() -> None:
    made()  # registers the terms
    env: Any = gym.make("bufgym/Uplink-v1", duration_s=1.0, reward="covered", actions="slots")
    env.reset(seed=0)
    with pytest.raises(BufgymError, match=r"of 30 messages: .* is for bufgym/Mapping-v0, of 240"):
        for _ in range(40):
            env.step(0)

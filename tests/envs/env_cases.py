"""What the tests of environments share: comparing, choosing valid actions, reading pictures."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from bufgym.envs import SenderEnv, render
from bufgym.model import qoi
from bufgym.model.topics import Topic
from bufgym.scenario import Client, Stream
from bufgym.traces import Trace

SMALL: dict[str, dict[str, Any]] = {
    "bufgym/Interruption-v1": {"t_max": 20},
    "bufgym/Uplink-v1": {"duration_s": 1.0},
    "bufgym/Suite-v1": {"suite": "interruption-v1"},
    "bufgym/Topics-v0": {"duration_s": 1.0},
}
"""Arguments that make episodes of every environment short."""

STREAMS = (
    Stream(Topic("pose", priority=5, rate_limit_hz=18, deadline_s=0.05), 20, 400, jitter=0.5),
    Stream(Topic("image", weight=2, limit=3, value=qoi.saturating(3), deadline_s=0.2), 15, 6_000, size_cv=0.6),
    Stream(Topic("command", priority=2, no_drop=True), 4, 100),
    Stream(Topic("log", weight=0), 10, 800),
)
"""Topics of every kind: a rate limit, a limit with a V of its own, no_drop, no weight."""
LINKS = (Trace.steps([(0.4, 60_000), (0.5, 0), (0.6, 40_000)]), Trace.steps([(0.7, 90_000), (0.2, 0)], after="stop"))


FADING = Trace.steps([(0.4, 9e6), (0.5, 0), (0.6, 2e6)])
DYING = Trace.steps([(0.4, 9e6), (0.3, 1e6)], after="stop")


def client(**parameters: Any) -> Client:
    """These streams over these links."""
    return Client(STREAMS, LINKS, **parameters)


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Whether two observations are equal bit for bit."""
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


def valid_action(mask: np.ndarray, rng: np.random.Generator) -> int:
    """A valid action, at random."""
    return int(rng.choice(np.flatnonzero(mask)))


def last_info(env: Any, act: Callable[[Any, dict[str, Any]], Any], **reset: Any) -> dict[str, Any]:
    """The last info of an episode whose actions follow from what is observed and the info."""
    seen, info = env.reset(**reset)
    ended = False
    while not ended:
        seen, _, ended, _, info = env.step(act(seen, info))
    return info


def text(env: SenderEnv) -> list[str]:
    """The frame without colours, line by line."""
    return re.sub(r"\x1b\[[0-9;]*m", "", render.ansi(env.sub_envs.senders, 0)).splitlines()

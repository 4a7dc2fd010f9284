"""``gymnasium.Env``: one sender."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bufgym.envs.rows import Rows
from bufgym.errors import BufgymError
from bufgym.scenario import Scenario

Observation = dict[str, NDArray[np.float32]]

_ROW = np.zeros(1, np.int64)


class SenderEnv(gym.Env[Observation, np.int64]):
    """A robot's send buffer holds L messages; a link that fades empties it; at every arrival, decide what goes.

    **Action** ``Discrete(L + 2)``: 0..L-1 evict that slot (0 = oldest) and enqueue the newcomer; L reject the newcomer;
    L + 1 accept it. ``action_masks()`` and ``info["action_mask"]`` say which are possible. An impossible action does
    what a queue does: accept where there is room, else reject; ``info["impossible"]`` counts them.

    **Observation** a Dict with one key for each field of ``bufgym.observe.FIELDS``: slot fields of shape (L + 1,) with
    the newcomer last, context fields of shape (1,), all in [0, 1].

    **Reward** one of the terms of ``bufgym.observe.REWARD_TERMS`` or a weighted sum: ``delivered`` and ``retained``
    both add up to H - 1 over an episode (to H where nothing was delivered, H = 0). ``info["reward_terms"]`` has each.

    **Several topics** (a scenario with ``topics``, as of ``bufgym/Topics-v0``): the free socket asks too. Where the
    field ``socket_asks`` is 1 there is no newcomer: an action 0..L-1 *sends* that slot, which must be the oldest of its
    topic; L *holds* the socket until the next arrival or pong, as long as one is to come; L + 1 is impossible. An
    impossible choice sends the oldest message. At an arrival all is as above, but a ``no_drop`` message can be neither
    evicted nor rejected while something else can make room; if that was tried and the queue is full, the oldest
    message of the lowest priority goes. Fields of ``bufgym.observe.TOPIC_FIELDS`` and the terms ``age`` and ``late``
    of ``TOPIC_REWARD_TERMS`` come in addition. H is the weighted sum over the topics, so ``delivered`` and ``retained``
    add up to H minus the weights of the topics of which anything was received.

    **End** ``terminated`` when the episode's last message has left. In the step that ends it, ``info`` also has
    ``qoi`` (H), ``arrived``, ``delivered``, ``dropped``. An episode that asks for no decision (``decide_at="overflow"``
    and never full) ends with the first step, whose action counts for nothing.

    **Arguments** ``scenario``: a name of ``bufgym.scenario.SCENARIOS`` or a scenario; ``capacity`` L; ``max_bytes`` B;
    ``decide_at``: "arrival" or "overflow" (only when full); ``reward``; ``fields``: names to observe (all by default);
    any further argument replaces a parameter of the scenario (``t_max=100``). ``reset(options={"episode": e})`` plays
    a given ``bufgym.scenario.Episode``.
    """

    metadata = {"render_modes": ["ansi", "rgb_array"], "render_fps": 10}

    def __init__(
        self,
        scenario: str | Scenario = "lte",
        capacity: int = 8,
        *,
        max_bytes: int | None = None,
        decide_at: str = "arrival",
        reward: str | Mapping[str, float] = "retained",
        fields: Sequence[str] | None = None,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise BufgymError(f"render_mode = {render_mode!r}: must be one of {self.metadata['render_modes']}")
        self.rows = Rows(
            1,
            scenario=scenario,
            capacity=capacity,
            max_bytes=max_bytes,
            decide_at=decide_at,
            reward=reward,
            fields=fields,
            parameters=parameters,
        )
        self.observation_space = cast(Any, self.rows.observation_space)
        self.action_space = self.rows.action_space
        self.render_mode = render_mode
        self._action = np.zeros(1, np.int64)
        self._weights = self.rows.weights.tolist()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None or self.rows.streams[0] is None:
            self.rows.seed(0, self.np_random)
        for name in options or {}:
            if name != "episode":
                raise BufgymError(f"options[{name!r}]: unknown; known: episode")
        self.rows.reset(_ROW, [(options or {}).get("episode")])
        return self._observation(), {"action_mask": self.action_masks(), "invalid": 0}

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        rows = self.rows
        if rows.senders.episodes[0] is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        if not 0 <= action < rows.capacity + 2:
            raise BufgymError(f"action = {action}: must lie in 0..{rows.capacity + 1} (L = {rows.capacity})")
        self._action[0] = action
        rows.step(self._action)
        terms = rows.shown.terms[0].tolist()
        reward = 0.0
        for weight, term in zip(self._weights, terms, strict=True):
            reward += weight * term
        info = {
            "action_mask": self.action_masks(),
            "invalid": rows.senders.batch.senders["invalid"].item(),
            "reward_terms": {term.name: terms[k] for k, term in enumerate(rows.terms)},
        }
        ended = rows.shown.ended.item()
        if ended:
            info |= {name: number.item() for name, number in rows.summary(0).items()}
        return self._observation(), reward, ended, False, info

    def action_masks(self) -> NDArray[np.bool_]:
        """bool[L + 2]: the actions that are possible now (the name that sb3-contrib looks for)."""
        mask: NDArray[np.bool_] = self.rows.shown.mask[0].copy()
        return mask

    def render(self) -> Any:
        """The buffer as a timeline of kept and dropped messages against the link's capacity."""
        if self.render_mode is None:
            gym.logger.warn("render() needs a render_mode: gym.make(..., render_mode='ansi' or 'rgb_array')")
            return None
        from bufgym.envs import render  # drawing is only loaded where it is wanted

        if self.render_mode == "ansi":
            return render.ansi(self.rows.senders, 0)
        return render.rgb_array(self.rows.senders, 0)

    def _observation(self) -> Observation:
        shown = self.rows.shown
        return self.rows.observation(shown.slots[0].copy(), shown.context[0].copy())

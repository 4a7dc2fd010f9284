"""``gymnasium.Env``: one sender."""

from dataclasses import replace
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from bufgym.envs.observation import Observation
from bufgym.envs.options import RENDER_MODES, Options, read_arguments
from bufgym.envs.sub_envs import NUMBERED, SubEnvs, check_entries
from bufgym.scenario import Scenario
from bufgym.utils.errors import BufgymError

_ROW = np.zeros(1, np.int64)


class SenderEnv(gym.Env[Observation, np.int64]):
    """A robot's send buffer holds L messages, and a fading link empties it: decide at a full buffer what to drop.

    **Action** ``Discrete(3)``, whatever L is: drop the cheapest candidate, the second cheapest, or the head.

    A candidate is a message that could go: each queued message, and the newcomer. Dropping it merges the motion gaps
    before and after it. The smaller the merged gap, the cheaper; where sizes differ, it counts per byte
    (``bufgym.model.observe.candidates``). Every action is valid: if a candidate is missing, its action drops the
    cheapest. ``info["slots"]`` names the slot that each action drops: 0 is the oldest, and L is the newcomer.

    With ``decide_at="arrival"`` every arrival asks, and action 0 of ``Discrete(4)`` accepts the newcomer if there is
    room, and drops the cheapest candidate if not. The others follow. If B has no room for the newcomer even after an
    eviction, the next step is about the same arrival, and the newcomer is no candidate.

    **Observation** 27 numbers, float32: six of each candidate and nine of the queue (``CANDIDATE_FIELDS`` and
    ``QUEUE_FIELDS`` of ``bufgym.model.observe``). Most are logarithms of ratios in [-3, 3], so they mean the same at
    every L, frame rate and size. ``observation="dict"`` gives an array for each field.

    **Reward** ``paired`` by default: what drops cost, less what they cost the rule ``reference``, which always drops
    the cheapest, on the same episode. It adds up to H less that rule's H. Other terms, or weights of several, go
    by name: ``bufgym.model.observe.REWARD_TERMS`` and ``OWN_TERMS`` say what each pays. ``info["reward_terms"]`` has
    each.

    **Slots** ``actions="slots"`` is the other interface, for networks that score every message. Its defaults are
    ``decide_at="arrival"`` and ``observation="dict"``.

    The action is ``Discrete(L + 2)``: 0..L-1 evict that slot, 0 being the oldest, and enqueue the newcomer; L rejects
    the newcomer; L + 1 accepts it. ``info["action_mask"]``, int8[L + 2], and ``action_masks()``, bool, mark the valid
    ones. An invalid action accepts if there is room and otherwise rejects; ``info["invalid"]`` counts them.

    The observation is a Dict with a float32 array for each of ``bufgym.model.observe.FIELDS``, all in [0, 1]. Slot
    fields have shape (L + 1,), with the newcomer last, context fields (1,). "flat" is one array, slot fields first.

    **Several topics** (a scenario with ``topics``, as of ``bufgym/Topics-v0``): actions are slots, and the environment
    asks at a free socket too. Where the field ``socket_asks`` is 1, an action 0..L-1 *sends* that slot, which must be
    the oldest of its topic, and L *holds* the socket until the next arrival or ack, as long as one is to come. An
    invalid choice sends the oldest message. At an arrival a ``no_drop`` message cannot go while another one can. If an
    action tries this and the queue is full, the oldest message of the lowest priority goes.

    The fields of ``TOPIC_FIELDS`` and the terms ``age`` and ``late`` are added. H is the weighted sum over the topics,
    so ``retained``, the default there, adds up to H minus the weights of all topics with a delivery.

    **Episode end** ``terminated`` when the last message has left; never ``truncated``. Then ``info`` also counts
    messages as ``arrived``, ``delivered`` and ``dropped``. Every step has ``qoi``, H of the messages delivered so far.
    An episode that asks for no decision (never full) ends with the first step, whose action has no effect.

    **Arguments** ``scenario`` is a name in ``bufgym.scenario.SCENARIOS``, ``module:function``, or a scenario. The
    fields of ``Options`` (``bufgym.envs.options``) say what the options mean. Any further argument replaces a parameter
    of the scenario (``t_max=100``), as an object or as the text of the command line (``value="saturating:0.5"``).

    ``reset(options={"episode": e})`` plays the ``bufgym.scenario.Episode`` e, and ``{"trace": t, "seed": s}`` the
    episode behind that row of ``bufgym bench``. On ``bufgym/Suite-v1`` add the row's ``scenario``; ``trace`` may be
    left out, as the seed tells it. ``reset(seed=s)`` begins a different sequence of episodes.

    Raises ``BufgymError`` for an unfit argument, option or action, and ``ResetNeeded`` for a step before a reset or
    after the end of the episode.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}
    _spec: EnvSpec | None = None

    def __init__(self, scenario: str | Scenario = "lte", capacity: int = Options.capacity, **arguments: Any) -> None:
        self.sub_envs = SubEnvs(1, *read_arguments(scenario, capacity=capacity, **arguments))
        self.render_mode = self.sub_envs.options.render_mode
        self._window = self.sub_envs.options.window()
        self.observation_space = self.sub_envs.observation_space
        self.action_space = self.sub_envs.action_space
        self._action = np.zeros(1, np.int64)
        self.sub_envs.output.terminated[0] = True  # kept with the other arrays, so a snapshot of them has it

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's. ``max_episode_steps`` is a number that no episode reaches with these arguments.

        Wrappers such as ``TimeAwareObservation`` read it. A registered one would cut episodes that arguments lengthen.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec and replace(spec, max_episode_steps=self.sub_envs.unreached_steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None or self.sub_envs.streams[0] is None:
            self.sub_envs.seed(0, self.np_random)
        options = {} if options is None else options
        check_entries(options, ("episode", *NUMBERED), "options")
        if "episode" in options and len(options) > 1:
            raise BufgymError(f"options: an episode, or its {', '.join(NUMBERED)}; not both")
        self.sub_envs.reset(_ROW, [options.get("episode", options or None)])
        self.sub_envs.output.terminated[0] = False  # also if no arrival asks: the first step then ends the episode
        if self._window is not None:
            self.render()
        return self.sub_envs.observation(0), self.sub_envs.info(0, False)

    def step(
        self, action: np.int64 | int | NDArray[np.floating[Any]]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        sub_envs, terminated = self.sub_envs, self.sub_envs.output.terminated
        if terminated.item():
            why = "" if sub_envs.senders.episodes[0] is None else "the episode has ended: "
            raise gym.error.ResetNeeded(f"{why}call reset() before step()")
        self._action[0] = sub_envs.action("action", action)
        sub_envs.step(self._action)
        ended = terminated.item()
        if self._window is not None:
            self.render()
        return sub_envs.observation(0), sub_envs.rewards().item(), ended, False, sub_envs.info(0, ended)

    def action_masks(self) -> NDArray[np.bool_]:
        """bool[actions]: the actions valid now, under the name that sb3-contrib looks for."""
        return cast(NDArray[np.bool_], self.sub_envs.action_masks()[0])

    def render(self) -> Any:
        """Kept and dropped messages as a timeline against the link's capacity: text, or uint8[400, 800, 3].

        With "human" it shows that image in the window, as each reset and step does, and returns None.
        """
        if self.render_mode is None:
            gym.logger.warn("render() needs a render_mode: gym.make(..., render_mode='ansi', 'rgb_array' or 'human')")
            return None
        from bufgym.envs import render  # loaded only to draw

        drawn = render.draw(self.sub_envs.senders, 0, self.render_mode, self.sub_envs.output.slot_actions[0])
        return drawn if self._window is None else self._window.show([drawn], self.metadata["render_fps"])

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

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

    A candidate is a message that could go: each queued message, and the newcomer. The message in transmission is none.
    Dropping a candidate merges the motion gaps before and after it. The smaller the merged gap, the cheaper the drop.
    Where sizes differ, the gap counts per byte. ``bufgym.model.observe.candidates`` has the definition.

    Every action is valid. If a candidate is missing, its action drops the cheapest. ``info["slots"]`` names the slot
    that each action drops: 0 is the oldest, and L is the newcomer.

    With ``decide_at="arrival"`` every arrival asks, and the space is ``Discrete(4)``. Action 0 then accepts the
    newcomer if there is room, and drops the cheapest candidate if not. The others follow.

    If B has no room for the newcomer even after an eviction, the next step is about the same arrival again, and the
    newcomer is no candidate. An arrival larger than B is dropped without a step.

    **Observation** 27 numbers, float32: six of each candidate and nine of the queue. Most are logarithms of ratios in
    [-3, 3], so they mean the same at every L, frame rate and size. ``CANDIDATE_FIELDS`` and ``QUEUE_FIELDS`` of
    ``bufgym.model.observe`` list them.

    ``observation="dict"`` gives an array for each field. "slots" gives ``slots`` [candidates, candidate fields] and
    ``context`` [queue fields].

    **Reward** one of the terms of ``bufgym.model.observe.REWARD_TERMS``, another term by its name, or a weighted sum.
    ``info["reward_terms"]`` has each term.

    Over an episode both ``delivered`` and ``retained`` add up to H - 1, or to 0 if nothing was delivered. The default
    is ``retained``, which charges a drop at once.

    ``cost`` leaves out of ``retained`` what arrivals bring whatever one does, and charges the gap behind the last
    message kept as it grows. It adds up to H - 1 less a constant of the episode, the sum of V over all steps in x, and
    needs nothing that a robot lacks. ``paired`` is ``cost`` less that of the rule ``reference`` on the same episode. It
    adds up to H less that rule's H, where H counts as 1 if nothing was delivered. ``bufgym.envs.cost`` has both.

    ``regret`` is the change of V*, the best H that can still be reached. It adds up to H - V*(start), so the best
    policy stays the same, and the luck of link and motion is taken out. V* needs the link's future. Only the reward
    sees that future: observations and evaluations never do. It serves one queue of messages of equal size.

    **Slots** ``actions="slots"`` is the other interface, for networks that score every message. Its defaults are
    ``decide_at="arrival"`` and ``observation="dict"``.

    The action is ``Discrete(L + 2)``. Actions 0..L-1 evict that slot, 0 being the oldest, and enqueue the newcomer. L
    rejects the newcomer. L + 1 accepts it.

    ``info["action_mask"]``, int8[L + 2], marks the valid actions for ``action_space.sample(mask)``. ``action_masks()``,
    bool[L + 2], does so for sb3-contrib. An invalid action does what a plain queue does: it accepts if there is room
    and otherwise rejects. ``info["invalid"]`` counts invalid actions.

    The observation is a Dict with one float32 array for each field of ``bufgym.model.observe.FIELDS``, all in [0, 1].
    Slot fields have shape (L + 1,), with the newcomer last. Context fields have shape (1,). With ``observation="flat"``
    the same numbers are one array, slot fields first. With "slots" they are a Dict of ``slots`` [L + 1, slot fields]
    and ``context``.

    **Several topics** (a scenario with ``topics``, as of ``bufgym/Topics-v0``): actions are slots, and the environment
    asks at a free socket too. Where the field ``socket_asks`` is 1 there is no newcomer. Then an action 0..L-1 *sends*
    that slot, which must be the oldest of its topic, and L + 1 is invalid. L *holds* the socket until the next arrival
    or ack, as long as one is to come. An invalid choice sends the oldest message.

    At an arrival all is as above, but a ``no_drop`` message can be neither evicted nor rejected while another message
    can make room. If an action tries this and the queue is full, the oldest message of the lowest priority goes.

    The fields of ``TOPIC_FIELDS`` and the terms ``age`` and ``late`` of ``TOPIC_REWARD_TERMS`` (both in
    ``bufgym.model.observe``) are added. H is the weighted sum over the topics, so ``delivered`` and ``retained`` add up
    to H minus the weights of all topics with a delivery.

    **Episode end** ``terminated`` when the episode's last message has left; never ``truncated``. In the step that ends
    it, ``info`` also counts messages as ``arrived``, ``delivered`` and ``dropped``.

    Every step has ``qoi``, H of the messages delivered so far, so episodes that a ``TimeLimit`` truncates have it too.
    An episode that asks for no decision (never full) ends with the first step, whose action has no effect.

    **Arguments**

    - ``scenario``: a name in ``bufgym.scenario.SCENARIOS``, ``module:function`` that makes one, or a scenario.
    - ``capacity``: L, messages.
    - ``max_bytes``: B, bytes, by default without limit.
    - ``actions``: "candidates", the default of one queue; or "slots", the only one of several topics.
    - ``candidates``: how many of the cheapest candidates are actions beside the head, 1 to 64.
    - ``repeat``: an action holds for so many decisions, by default 1. At each of them its place in the order of
      candidates is looked up anew. Rewards add up over them, and an episode's end cuts them short. For candidates.
    - ``decide_at``: "overflow" asks only when the buffer is full, "arrival" at every arrival. Candidates are asked at
      overflow by default, slots at arrivals.
    - ``observation``: "flat", the default of candidates; "dict", the default of slots; or "slots".
    - ``fields``: with candidates, names of fields to observe beside the 27 numbers, your own or those of
      ``ON_BOARD_FIELDS``. With slots, names of the fields to observe, by default all of the tables; "compact" means all
      of the context's.
    - ``reward``: a term's name, or weights by name; terms outside ``REWARD_TERMS`` take part only if named.
    - ``reference``: the rule of ``paired``, a compiled policy or its name; "min-motion-gap" always drops the cheapest.
    - ``reward_scale``: factor on the reward, by default none. "episode" is the constant ``reward_scale`` of the
      scenario's class, which brings a rule's return in a default episode between 1 and 10; weights of your own terms
      stay as they are. ``info["reward_terms"]`` is not scaled.
    - ``info``: "full"; "summary" adds the summary so far in every step, for recorders; "mask" has the mask alone,
      and at an episode's end its summary; "none" has only this summary.
    - ``mask_in_observation``: whether observations hold the action mask, for libraries that look for it there. True
      puts ``action_mask`` beside the fields. Two names, or the library they belong to, make a nested dict: "rllib"
      (``observations``, ``action_mask``), "tianshou" (``obs``, ``mask``), "pettingzoo" (``observation``,
      ``action_mask``). A "flat" observation is always nested, by True as for "pettingzoo".
    - ``mask_dtype``: "int8" or "bool", of the mask in observations; in ``info`` it is int8, which Gymnasium samples by.
    - ``render_mode``: "ansi", "rgb_array", or "human" for a window that shows each step (extra ``human``).
    - ``bound``: whether the last ``info`` also has ``clairvoyant``, ``certified``, ``regret`` and ``score``, for one
      queue only. The clairvoyant is the best H where ``certified`` is 1, otherwise an upper bound of it. The score is 0
      for Drop Oldest and 1 for the clairvoyant, NaN where they are equal. Computing them takes a tenth of a second
      after a long episode.
    - ``pool``: take every episode from a fixed set of so many, each drawn once, instead of drawing a new one at each
      reset. The set, a ``bufgym.scenario.numbered.Pool``, is the same for every seed. None for no pool.
    - any further argument replaces a parameter of the scenario (``t_max=100``). It is an object or the text that the
      command line takes (``value="saturating:0.5"``, ``traces="lte-synthetic-0"``).

    ``reset(options={"episode": e})`` plays the ``bufgym.scenario.Episode`` e, and
    ``reset(options={"trace": t, "seed": s})`` the episode behind that row of ``bufgym bench``, where ``trace`` is the
    row's label or number. On ``bufgym/Suite-v0`` add the row's ``scenario``; ``trace`` may be left out, as the seed
    tells it. ``reset(seed=s)`` begins a different sequence of episodes.

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

"""``pettingzoo.ParallelEnv``: robots that share one cell, each with a send buffer of its own."""

import copy
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray

from bufgym.envs.fleet_sub_envs import fleet_sub_envs
from bufgym.envs.observation import Observation
from bufgym.envs.options import RENDER_MODES, Options
from bufgym.model.observe.candidates import MOST
from bufgym.scenario import FleetScenario, Uplink
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import needs

with needs("pettingzoo", "fleet", "FleetEnv"):
    from pettingzoo import ParallelEnv

Infos = dict[str, dict[str, Any]]
Spaces = dict[str, spaces.Space[Any]]


class FleetEnv(ParallelEnv[str, Observation, int]):
    """N robots send camera frames through one cell that divides its capacity among the robots now sending.

    **A step is one frame tick**: all cameras tick together, so every robot decides about its newcomer at the same
    moment and without knowing the others' decisions. Then the cell carries as much as it can until the next tick.
    Under a byte limit a robot may be asked again about the same newcomer (see ``SenderEnv``), in one more step of the
    same tick. In that step, robots without a decision due observe zeros and have one valid action, L, without effect.

    **Agents** ``robot_0`` .. ``robot_{N-1}``, N up to 256.

    **Action, observation** of each robot are as in ``SenderEnv`` with ``actions="slots"``, the default here: there are
    ``Discrete(L + 2)``, and the observation is a Dict with one key for each field of ``bufgym.model.observe``. With
    ``actions="candidates"`` they are a few ordered candidates and 27 numbers, for every L. A robot observes what it has
    on board. ``infos[agent]["action_mask"]`` marks the valid actions.
    ``state()`` has every field of every robot, for critics that may see them all.

    **Reward** "team" gives each robot the mean over all robots of ``term``, which is the reward of ``SenderEnv``.
    "own" gives each robot its own. ``infos[agent]["reward_terms"]`` has each robot's own terms in any case.

    **Episode end** all agents are ``terminated`` together, when the last message of the episode has left; none is ever
    ``truncated``. The last infos have the same entries as in ``SenderEnv``.

    **Arguments**

    - ``robots``: N.
    - ``scenario``: the name of an uplink, an ``Uplink`` (as each robot would have it alone) or a ``FleetScenario``.
    - ``capacity``: L of every robot, messages.
    - ``max_bytes``: B, bytes.
    - ``reward``: "team" or "own".
    - ``term``: as ``reward`` in ``SenderEnv``, and so are its other options, but for ``bound``.
    - any further argument replaces a parameter of the uplink.

    ``reset(options={"episode": e})`` plays the ``FleetEpisode`` e; other options are ignored, as in PettingZoo.
    """

    metadata = {
        "name": "bufgym_fleet_v0",
        "render_modes": list(RENDER_MODES),
        "is_parallelizable": True,
        "render_fps": 10,
    }

    def __init__(
        self,
        robots: int = 4,
        scenario: str | Uplink | FleetScenario = "lte",
        capacity: int = Options.capacity,
        **arguments: Any,
    ) -> None:
        self.sub_envs = fleet_sub_envs(1, FleetScenario.of(robots, scenario), capacity=capacity, **arguments)
        self.render_mode = self.sub_envs.options.render_mode
        self._window = self.sub_envs.options.window()
        self.possible_agents = [f"robot_{i}" for i in range(len(self.sub_envs))]
        self.agents: list[str] = []
        self.np_random, _ = seeding.np_random()
        # PettingZoo seeds an agent by seeding its spaces, so each agent has its own.
        one = self.sub_envs.observation_space
        self.observation_spaces: Spaces = {agent: copy.deepcopy(one) for agent in self.possible_agents}
        actions = self.sub_envs.actions_count
        self.action_spaces: Spaces = {agent: spaces.Discrete(actions) for agent in self.possible_agents}
        low, high = (0.0, 1.0) if self.sub_envs.choices is None else (-MOST, MOST)
        self.state_space = spaces.Box(low, high, self.state().shape, np.float32)
        self._actions = np.zeros(len(self.sub_envs), np.int64)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], Infos]:
        sub_envs = self.sub_envs
        if seed is not None:
            self.np_random, _ = seeding.np_random(seed)
        if seed is not None or sub_envs.streams[0] is None:
            sub_envs.seed(0, self.np_random)
        sub_envs.reset(np.arange(len(sub_envs)), [(options or {}).get("episode")])
        self.agents = list(self.possible_agents)
        if self._window is not None:
            self.render()
        return self._observations(), self._infos(False)

    def step(
        self, actions: Mapping[str, int]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        sub_envs, agents = self.sub_envs, self.agents
        if not agents:
            raise gym.error.ResetNeeded("call reset() before step()")
        for i, agent in enumerate(agents):
            action = actions.get(agent)
            if action is None:
                raise BufgymError(f"actions: none for {agent!r}; every robot decides at every tick")
            self._actions[i] = sub_envs.action(f"actions[{agent!r}]", action)
        sub_envs.step(self._actions)
        terminated = bool(sub_envs.output.terminated[0])
        if terminated:
            self.agents = []
        if self._window is not None:
            self.render()
        return (
            self._observations(),
            dict(zip(agents, sub_envs.rewards().tolist(), strict=True)),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, False),
            self._infos(terminated),
        )

    def state(self) -> NDArray[np.float32]:
        """float32[N x fields]: robot by robot, all slot fields of the tables, then all context fields."""
        return self.sub_envs.output.flat[:, : self.sub_envs.form.table_numbers].flatten()

    def render(self) -> Any:
        """A line for each robot with its buffer and the fate of its messages, as text or as uint8[400, 800, 3].

        With "human" it shows that image in the window, as each reset and step does, and returns None.
        """
        if self.render_mode is None:
            gym.logger.warn("render() needs a render_mode: FleetEnv(..., render_mode='ansi', 'rgb_array' or 'human')")
            return None
        if self.sub_envs.senders.episodes[0] is None:
            raise gym.error.ResetNeeded("call reset() before render()")
        from bufgym.envs.render import cell  # loaded only to draw

        draw = cell.cell_ansi if self.render_mode == "ansi" else cell.cell_rgb_array
        drawn: Any = draw(self.sub_envs, self.possible_agents)
        return drawn if self._window is None else self._window.show([drawn], self.metadata["render_fps"])

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _observations(self) -> dict[str, Observation]:
        return {agent: self.sub_envs.observation(i) for i, agent in enumerate(self.possible_agents)}

    def _infos(self, terminated: bool) -> Infos:
        return {agent: self.sub_envs.info(i, terminated) for i, agent in enumerate(self.possible_agents)}

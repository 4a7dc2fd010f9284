"""PufferLib's native environment: n senders that write into arrays of its own. Needs ``pip install pufferlib``."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray

from bufgym.envs.rows import Rows
from bufgym.ground.errors import BufgymError
from bufgym.model.checks import whole
from bufgym.scenario import Scenario

try:
    import pufferlib
except ModuleNotFoundError as error:
    if error.name != "pufferlib":
        raise
    raise BufgymError("PufferSenders needs pufferlib: pip install pufferlib") from None


class PufferSenders(pufferlib.PufferEnv):  # type: ignore[misc]
    """A batch of ``SenderEnv`` with flat observations, for ``pufferlib.vector`` and its trainer.

    With all fields of the tables, kernels write observations straight into PufferLib's array. Rows that end begin anew
    at once. PufferLib knows no action masks: an invalid action does what a plain queue does. ``action_masks()`` returns
    the masks. The infos of a step have a dict for each episode that ended in it, with ``qoi``, ``arrived``,
    ``delivered``, ``dropped`` and ``invalid``.

        import pufferlib.vector
        from bufgym.envs.puffer import PufferSenders

        envs = pufferlib.vector.make(PufferSenders, env_kwargs={"num_envs": 1024, "capacity": 16})

    For several processes add ``num_envs=2, backend=pufferlib.vector.Multiprocessing``.
    """

    def __init__(
        self,
        num_envs: int = 1024,
        scenario: str | Scenario = "lte",
        capacity: int = 8,
        *,
        buf: Any = None,
        seed: int | None = None,
        **options: Any,
    ) -> None:
        """``buf``: PufferLib's arrays. ``seed``: as in ``reset``. ``options``: arguments of ``SenderEnv``."""
        for name, value in (("observation", "flat"), ("info", "none")):
            if options.setdefault(name, value) != value:
                raise BufgymError(f"{name} = {options[name]!r}: must be {value!r} for PufferLib")
        self.num_agents = whole("num_envs", num_envs, 1)
        self.rows = Rows(self.num_agents, scenario, capacity, **options)
        self.single_observation_space = cast(spaces.Box, self.rows.observation_space)
        self.single_action_space = self.rows.action_space
        super().__init__(buf)
        self._seed = seed
        output, shown = self.rows.output, self.observations
        fits = shown.shape == output.flat.shape and shown.dtype == np.float32 and shown.flags.c_contiguous
        if fits:
            self.rows.output = output._replace(flat=shown)

    def reset(self, seed: int | None = None) -> tuple[NDArray[np.float32], list[dict[str, float]]]:
        """Begin an episode in every row; row i is seeded with ``seed`` + i."""
        seed = self._seed if seed is None else seed
        self._seed = None
        for i in range(self.num_agents):
            if seed is not None or self.rows.streams[i] is None:
                self.rows.seed(i, seeding.np_random(None if seed is None else seed + i)[0])
        self.rows.reset(np.arange(self.num_agents))
        self._show()
        self.rewards[:], self.terminals[:], self.truncations[:] = 0.0, False, False
        return self.observations, []

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], list[dict[str, float]]]:
        """Take one decision in every row."""
        rows = self.rows
        if rows.senders.episodes[0] is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        rows.step(rows.actions(actions))
        self.rewards[:], self.terminals[:] = rows.rewards(), rows.output.terminated
        ended = np.flatnonzero(rows.output.terminated)
        infos: list[dict[str, float]] = []
        if len(ended):
            columns = rows.summary(ended)
            infos = [{name: column[k].item() for name, column in columns.items()} for k in range(len(ended))]
            rows.reset(ended)
        self._show()
        return self.observations, self.rewards, self.terminals, self.truncations, infos

    def action_masks(self) -> NDArray[np.bool_]:
        """bool[n, L + 2]: the actions valid now in each row."""
        return self.rows.action_masks()

    def close(self) -> None:
        """Do nothing: no resource is open."""

    def _show(self) -> None:
        """Copy observations into PufferLib's array if the kernels did not write them there."""
        if self.rows.output.flat is not self.observations:
            self.observations[:] = self.rows.observation()

"""Native Gymnasium vector environments for stable-baselines3, which accepts nothing but its own ``VecEnv``.

stable-baselines3 itself batches single environments, one Python call a step and environment. ``GymVecEnv`` gives it a
``gymnasium.vector.VectorEnv`` instead, so that a compiled batch stays one call:

    from bufgym.sb3 import make_vec_env
    from sb3_contrib import MaskablePPO

    model = MaskablePPO("MultiInputPolicy", make_vec_env("bufgym/Uplink-v0", 256, seed=0), batch_size=4096)
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common import env_util
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from bufgym.errors import BufgymError


def make_vec_env(id: str, num_envs: int, seed: int | None = None, **kwargs: Any) -> VecEnv:
    """``num_envs`` environments of that Gymnasium id for stable-baselines3; ``kwargs`` go to the environment.

    The native batch where the id has one that can reset in the same step (all of bufgym's can), else
    stable-baselines3's own batch of single environments. With a ``seed``, environment i starts from seed + i at the
    first reset.
    """
    entry = gym.spec(id).vector_entry_point
    native = load_env_creator(entry) if isinstance(entry, str) else entry
    # Gymnasium's own native batches know NEXT_STEP only.
    if native is None or "autoreset_mode" not in inspect.signature(native).parameters:
        return env_util.make_vec_env(id, num_envs, seed, env_kwargs=kwargs)
    kwargs = {"autoreset_mode": AutoresetMode.SAME_STEP, **kwargs}
    envs = GymVecEnv(gym.make_vec(id, num_envs, vectorization_mode="vector_entry_point", **kwargs))
    if seed is not None:
        envs.seed(seed)
    return envs


class GymVecEnv(VecEnv):
    """A native ``gymnasium.vector.VectorEnv`` with SAME_STEP autoreset as a stable-baselines3 ``VecEnv``.

    In the step that ends an episode its info has all that the environment reports at the end, ``terminal_observation``,
    ``TimeLimit.truncated``, and ``episode`` = {r: sum of rewards, l: steps, t: seconds since this object was made}, as
    stable-baselines3's ``Monitor`` writes it. Infos of the steps between are empty (n dicts a step cost more than a
    compiled step of n environments) unless ``step_infos``.

    ``env_method(name)`` calls the batch's method once and returns its rows, so ``action_masks`` costs one call.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any], *, step_infos: bool = False) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode is None or AutoresetMode(mode) != AutoresetMode.SAME_STEP:
            raise BufgymError(
                f"autoreset_mode = {mode}: stable-baselines3 needs SAME_STEP, as in "
                "gym.make_vec(..., autoreset_mode=AutoresetMode.SAME_STEP)"
            )
        self.envs = envs
        self.step_infos = step_infos
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        self._vector_options: dict[str, Any] | None = None
        self._actions: NDArray[Any] = np.zeros(0)
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)
        self._born = time.perf_counter()

    def reset(self) -> VecEnvObs:
        # Vector environments take a seed each, too, though the base class does not say so.
        seeds: Any = None if all(seed is None for seed in self._seeds) else self._seeds
        observation, info = self.envs.reset(seed=seeds, options=self._vector_options)
        self.reset_infos = [_row(info, i) for i in range(self.num_envs)]
        self._reset_seeds()  # seeds and options hold for one reset
        self.set_options(None)
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observation  # type: ignore[no-any-return]

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        observation, rewards, terminated, truncated, info = self.envs.step(self._actions)
        done = np.logical_or(terminated, truncated)
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = (
            [_row(info, i) for i in range(self.num_envs)] if self.step_infos else [{} for _ in range(self.num_envs)]
        )
        for i in np.flatnonzero(done).tolist():
            infos[i] = _row(info.get("final_info", {}), i) | {
                "terminal_observation": _final_observation(info["final_obs"], i),
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "episode": {
                    "r": float(self._returns[i]),
                    "l": int(self._lengths[i]),
                    "t": time.perf_counter() - self._born,
                },
            }
        self._returns[done] = 0.0
        self._lengths[done] = 0
        return observation, np.asarray(rewards, np.float32), done, infos

    def close(self) -> None:
        self.envs.close()

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Options of the next reset, in the vector environment's own form: ``{"episodes": [...]}``."""
        if isinstance(options, list):
            raise BufgymError(
                "set_options: a vector environment takes one dict of options for all its environments, not a list"
            )
        self._vector_options = options or None

    def has_attr(self, attr_name: str) -> bool:
        return hasattr(self.envs.unwrapped, _SINGLE.get(attr_name, attr_name))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The batch's attribute, once for each index: environments of a native batch share it."""
        value = getattr(self.envs.unwrapped, _SINGLE.get(attr_name, attr_name))
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set it for the whole batch."""
        if sorted(self._get_indices(indices)) != list(range(self.num_envs)):
            raise BufgymError(f"set_attr({attr_name!r}): environments of one batch share it; set it for all of them")
        setattr(self.envs.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call the method on the whole batch; each index's row of what it returns."""
        returned = getattr(self.envs.unwrapped, method_name)(*args, **kwargs)
        by_row = isinstance(returned, np.ndarray | list | tuple) and len(returned) == self.num_envs
        return [returned[i] if by_row else returned for i in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """True for ``Monitor``, whose work is done here (``evaluate_policy`` asks); a native batch has no others."""
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        images: Any = self.envs.render()
        return [None] * self.num_envs if images is None else list(images)

    def render(self, mode: str | None = None) -> Any:
        """One tiled picture for "rgb_array"; for "ansi" the texts of all environments, as the batch gives them."""
        if (mode or self.render_mode) == self.render_mode == "ansi":
            return self.envs.render()
        return super().render(mode)


_SINGLE = {"observation_space": "single_observation_space", "action_space": "single_action_space"}
"""What stable-baselines3 calls an attribute of one environment -> what a vector environment calls it."""


def _row(info: Mapping[str, Any], i: int) -> dict[str, Any]:
    """Environment ``i``'s info out of a vector environment's, where ``_key`` masks the rows that have ``key``."""
    own: dict[str, Any] = {}
    for key, column in info.items():
        if key.startswith("_") and key[1:] in info:
            continue
        mask = info.get(f"_{key}")
        if mask is not None and not mask[i]:
            continue
        if isinstance(column, Mapping):
            own[key] = _row(column, i)
        else:
            entry = column[i]
            own[key] = entry.item() if isinstance(entry, np.generic) else entry
    return own


def _final_observation(final: Any, i: int) -> Any:
    """Environment ``i``'s last observation from ``final_obs``: one array an environment, or a batched dict."""
    return _row(final, i) if isinstance(final, Mapping) else final[i]

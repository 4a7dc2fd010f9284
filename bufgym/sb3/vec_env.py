"""Native Gymnasium vector environments for stable-baselines3, which accepts only its own ``VecEnv``.

stable-baselines3 itself batches single environments, with one Python call per step and environment. ``GymVecEnv`` gives
it a ``gymnasium.vector.VectorEnv`` instead, so a compiled batch stays one call:

    from bufgym.sb3 import make_vec_env
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", make_vec_env("bufgym/Uplink-v1", 8, seed=0), n_steps=256)
"""

import inspect
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray
from stable_baselines3.common import env_util
from stable_baselines3.common.monitor import Monitor, ResultsWriter
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from bufgym.utils.errors import BufgymError, UnknownArgumentError


def make_vec_env(
    env_id: str, n_envs: int = 1, seed: int | None = None, *, monitor_dir: str | None = None, **settings: Any
) -> VecEnv:
    """Make a native batch of ``n_envs`` environments for stable-baselines3.

    Args:
        env_id: an id whose native batch can reset in the same step, as all of bufgym's can.
        n_envs: environments.
        seed: row i starts from seed + i at the first reset.
        monitor_dir: folder that gets one file, ``0.monitor.csv``, with the episodes of all environments;
            ``load_results`` reads it.
        settings: of the environment.
    """
    instead = "stable_baselines3.common.env_util.make_vec_env has single environments"
    named = {"num_envs": "stable-baselines3 calls it n_envs", "env_kwargs": "settings go by name, as in capacity=8"}
    for name in settings.keys() & {*named, *inspect.signature(env_util.make_vec_env).parameters}:
        ours = named.get(name, instead)
        raise UnknownArgumentError(f"make_vec_env() got an unexpected keyword argument {name!r}: {ours}")
    if not _has_native_batch(env_id):
        raise BufgymError(f"env_id = {env_id!r}: has no native batch that resets in the same step; {instead}")
    options: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, **settings}
    envs: Any = gym.make_vec(env_id, n_envs, vectorization_mode="vector_entry_point", **options)
    results = None
    if monitor_dir is not None:
        header: dict[str, Any] = {"t_start": time.time(), "env_id": env_id}
        results = ResultsWriter(str(Path(monitor_dir) / "0"), header)
    batch = GymVecEnv(envs, results=results)
    if seed is not None:
        batch.seed(seed)
        batch.action_space.seed(seed)
    return batch


def _has_native_batch(env_id: Any) -> bool:
    """Whether Gymnasium knows the id and a native batch of it that can reset in the same step."""
    entry = gym.spec(env_id.split(":")[-1]).vector_entry_point if isinstance(env_id, str) else None
    native = load_env_creator(entry) if isinstance(entry, str) else entry
    # Gymnasium's own native batches support NEXT_STEP only.
    return native is not None and "autoreset_mode" in inspect.signature(native).parameters


class GymVecEnv(VecEnv):
    """A native ``gymnasium.vector.VectorEnv`` with SAME_STEP autoreset as a stable-baselines3 ``VecEnv``.

    At an episode's end ``info`` has all the environment's final entries, ``terminal_observation``,
    ``TimeLimit.truncated`` and ``episode``. As with stable-baselines3's ``Monitor``, ``episode`` is {r: sum of rewards,
    l: steps, t: seconds since this object was made}; it also goes to ``results`` if given. Infos of other steps are
    empty, as n dicts cost more than a compiled step of n environments.

    ``env_method(name)`` calls the batch's method once and returns its results, so ``action_masks`` costs one call.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any], *, results: ResultsWriter | None = None) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode is None or AutoresetMode(mode) != AutoresetMode.SAME_STEP:
            raise BufgymError(
                f"autoreset_mode = {mode}: stable-baselines3 needs SAME_STEP, as in "
                "gym.make_vec(..., autoreset_mode=AutoresetMode.SAME_STEP)"
            )
        self.envs = envs
        self.results = results
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        self._vector_options: dict[str, Any] | None = None
        self._actions: NDArray[Any] = np.zeros(0)
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)
        self._born = time.perf_counter()

    def reset(self) -> VecEnvObs:
        # Vector environments take a seed each, although the base class does not say so.
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
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done).tolist():
            infos[i] = _row(info.get("final_info", {}), i) | {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "episode": self._episode(i),
            }
        self._returns[done] = 0.0
        self._lengths[done] = 0
        return observation, np.asarray(rewards, np.float32), done, infos

    def _episode(self, i: int) -> dict[str, Any]:
        """Entries of ``Monitor`` for the episode that environment ``i`` has ended."""
        episode = {"r": float(self._returns[i]), "l": int(self._lengths[i]), "t": time.perf_counter() - self._born}
        if self.results is not None:
            self.results.write_row({**episode, "r": round(episode["r"], 6), "t": round(episode["t"], 6)})
        return episode

    def close(self) -> None:
        self.envs.close()
        if self.results is not None:
            self.results.close()

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Options of the next reset, in the vector environment's own form: ``{"episodes": [...]}``."""
        if isinstance(options, list):
            raise BufgymError(
                "set_options: a vector environment takes one dict of options for all its environments, not a list"
            )
        self._vector_options = options or None

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
        """Call the method on the whole batch, and return each index's row of the result."""
        returned = getattr(self.envs.unwrapped, method_name)(*args, **kwargs)
        by_row = isinstance(returned, np.ndarray | list | tuple) and len(returned) == self.num_envs
        return [returned[i] if by_row else returned for i in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """True for ``Monitor``, whose work is done here (``evaluate_policy`` asks), and for wrappers of the batch."""
        wrapped, envs = issubclass(wrapper_class, Monitor), self.envs
        while isinstance(envs, VectorWrapper):
            wrapped, envs = wrapped or isinstance(envs, wrapper_class), envs.env
        return [wrapped for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        images: Any = self.envs.render()
        return [None] * self.num_envs if images is None else list(images)

    def render(self, mode: str | None = None) -> Any:
        """One tiled picture for "rgb_array"; for "ansi" the texts of all environments, as the batch gives them."""
        if (mode or self.render_mode) == self.render_mode == "ansi":
            return self.envs.render()
        return super().render(mode)


_SINGLE = {"observation_space": "single_observation_space", "action_space": "single_action_space"}
"""stable-baselines3's name of an attribute of one environment -> its name in a vector environment."""


def _row(info: Mapping[str, Any], i: int) -> dict[str, Any]:
    """Extract environment ``i``'s info from a vector environment's, where ``_key`` masks those that have ``key``."""
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

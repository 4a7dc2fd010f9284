"""``gymnasium.vector.VectorEnv``: n senders stepped by one compiled call, the native form of the environment."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from bufgym.envs.rows import Rows, Shown
from bufgym.envs.single import Observation, SenderEnv
from bufgym.errors import BufgymError
from bufgym.scenario import Scenario

_ENDED = ("qoi", "arrived", "delivered", "dropped")


class SenderVectorEnv(VectorEnv[Observation, NDArray[np.int64], NDArray[Any]]):
    """A batch of ``SenderEnv``: same arguments, same episodes row by row, one compiled step for all rows.

    With several topics some rows may ask what to drop and others what to send: ``socket_asks`` says which.

    ``reset(seed=s)`` seeds row i with s + i, as Gymnasium's own vector environments do. ``info`` follows their form
    too: ``info["action_mask"]`` bool[n, L + 2], ``info["impossible"]``, ``info["reward_terms"]``; with SAME_STEP
    autoreset ``info["final_obs"]`` and ``info["final_info"]`` for rows that ended (``info["_final_obs"]`` says which).
    Arrays that a step hands out are never written again while anyone holds them.
    """

    metadata = {
        "render_modes": ["ansi", "rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scenario: str | Scenario = "lte",
        capacity: int = 8,
        *,
        max_bytes: int | None = None,
        decide_at: str = "arrival",
        reward: str | Mapping[str, float] = "retained",
        fields: Sequence[str] | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise BufgymError(f"num_envs = {num_envs!r}: must be a whole number >= 1")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise BufgymError(f"max_episode_steps = {max_episode_steps}: must be >= 1, or None for no limit")
        if render_mode is not None and render_mode not in SenderEnv.metadata["render_modes"]:
            raise BufgymError(f"render_mode = {render_mode!r}: must be one of {SenderEnv.metadata['render_modes']}")
        self.rows = Rows(
            int(num_envs),
            scenario=scenario,
            capacity=capacity,
            max_bytes=max_bytes,
            decide_at=decide_at,
            reward=reward,
            fields=fields,
            parameters=parameters,
        )
        self.num_envs = int(num_envs)
        self.max_episode_steps = max_episode_steps
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise BufgymError(f"autoreset_mode = {autoreset_mode!r}: must be one of {known}") from None
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self.single_observation_space = self.rows.observation_space
        self.single_action_space = self.rows.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._steps = np.zeros(self.num_envs, np.int64)
        self._done = np.zeros(self.num_envs, np.bool_)
        self._every_row = np.ones(self.num_envs, np.bool_)
        self._pool: list[Shown] = []

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        options = options or {}
        for name in options:
            if name not in ("reset_mask", "episodes"):
                raise BufgymError(f"options[{name!r}]: unknown; known: reset_mask (bool[n]), episodes (one a row)")
        seeds = [None] * self.num_envs if seed is None else seed
        if isinstance(seeds, int | np.integer):
            self._np_random, self._np_random_seed = seeding.np_random(int(seeds))
            seeds = [int(seeds) + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise BufgymError(f"seed: {len(seeds)} seeds for {self.num_envs} environments")
        mask = np.asarray(options.get("reset_mask", self._every_row), np.bool_)
        if mask.shape != (self.num_envs,):
            raise BufgymError(f"options['reset_mask'] has shape {mask.shape}: must be ({self.num_envs},)")
        if any(self.rows.senders.episodes[i] is None for i in np.flatnonzero(~mask)):
            raise gym.error.ResetNeeded("options['reset_mask'] leaves out rows that have no episode yet")
        self._turn_page(keep=True)
        chosen = np.flatnonzero(mask)
        for i in chosen.tolist():
            if seeds[i] is not None:
                self.rows.seed(i, seeding.np_random(seeds[i])[0])
        self.rows.reset(chosen, options.get("episodes"))
        self._steps[mask] = 0
        self._done = self._done & ~mask  # a new array: the last step may have handed out this one
        return self._observation(), self._info(terms=False)

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        rows = self.rows
        actions = np.ascontiguousarray(actions, np.int64)
        if actions.shape != (self.num_envs,):
            raise BufgymError(f"actions have shape {actions.shape}: must be ({self.num_envs},)")
        if actions.min() < 0 or actions.max() >= rows.capacity + 2:
            wrong = int(np.argmax((actions < 0) | (actions >= rows.capacity + 2)))
            raise BufgymError(f"actions[{wrong}] = {actions[wrong]}: must lie in 0..{rows.capacity + 1}")
        if rows.senders.episodes[-1] is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._done.any():
            raise gym.error.ResetNeeded("rows have ended: call reset(options={'reset_mask': done}) first")
        restart = self.autoreset_mode == AutoresetMode.NEXT_STEP and self._done.any()
        self._turn_page()
        rows.step(actions)  # rows that have ended stay as they are
        self._steps += 1
        if restart:
            rows.reset(np.flatnonzero(self._done))
            rows.shown.terms[self._done] = 0.0
            self._steps[self._done] = 0
        shown = rows.shown
        # Written out as in the single environment: a matrix product may round differently.
        rewards = np.zeros(self.num_envs)
        for k, weight in enumerate(rows.weights.tolist()):
            rewards += weight * shown.terms[:, k]
        terminated = shown.ended & ~self._done if restart else shown.ended.copy()
        truncated = np.zeros(self.num_envs, np.bool_)
        if self.max_episode_steps is not None:
            truncated = self._steps >= self.max_episode_steps  # as Gymnasium's TimeLimit: also where it ends anyway
        self._done = terminated | truncated
        info: dict[str, Any] = {}
        if self._done.any():
            info = self._end(self._done)
        info |= self._info()
        return self._observation(), rewards, terminated, truncated, info

    def action_masks(self) -> NDArray[np.bool_]:
        """bool[n, L + 2]: the actions that are possible now in each row."""
        return self.rows.shown.mask.copy()

    def render(self) -> Any:
        """Each row as the single environment renders it."""
        from bufgym.envs import render

        if self.render_mode is None:
            gym.logger.warn("render() needs a render_mode: gym.make_vec(..., render_mode='ansi' or 'rgb_array')")
            return None
        draw = render.ansi if self.render_mode == "ansi" else render.rgb_array
        return tuple(draw(self.rows.senders, i) for i in range(self.num_envs))

    def _end(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        """What ended rows report; with SAME_STEP they begin anew at once."""
        rows = self.rows
        summary = rows.summary(slice(None))
        ended = done & rows.shown.ended
        report: dict[str, Any] = {}
        for name in _ENDED:
            report[name] = np.where(ended, summary[name], 0)
            report[f"_{name}"] = ended
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            return report if ended.any() else {}
        if not ended.any():
            report = {}
        # One observation for each row that ended, None for the others, as in Gymnasium's SyncVectorEnv.
        final: NDArray[Any] = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(done):
            final[i] = rows.observation(rows.shown.slots[i].copy(), rows.shown.context[i].copy())
        mask = np.where(done[:, None], rows.shown.mask, False)
        last = self._info() | {"action_mask": mask, "_action_mask": done, "_invalid": done, "_reward_terms": done}
        last["invalid"] = np.where(done, last["invalid"], 0)
        rows.reset(np.flatnonzero(done))
        self._steps[done] = 0
        return {"final_obs": final, "_final_obs": done, "final_info": report | last, "_final_info": done}

    def _info(self, terms: bool = True) -> dict[str, Any]:
        shown, everywhere = self.rows.shown, self._every_row
        info: dict[str, Any] = {
            "action_mask": shown.mask,
            "_action_mask": everywhere,
            "invalid": self.rows.senders.batch.senders["invalid"].copy(),
            "_invalid": everywhere,
        }
        if terms:
            info["reward_terms"] = {}
            for k, term in enumerate(self.rows.terms):
                info["reward_terms"][term.name] = shown.terms[:, k]
                info["reward_terms"][f"_{term.name}"] = everywhere
            info["_reward_terms"] = everywhere
        return info

    def _observation(self) -> Observation:
        return self.rows.observation(self.rows.shown.slots, self.rows.shown.context)

    def _turn_page(self, keep: bool = False) -> None:
        """Let the next step write where nobody looks: arrays that are still held outside stay as they are."""
        rows, before = self.rows, self.rows.shown
        if not any(before is shown for shown in self._pool):
            self._pool.append(before)
        for shown in self._pool:
            # Held by its own tuple and by this loop's call only: no view of it is left outside.
            if all(sys.getrefcount(array) <= _OWN_REFERENCES for array in shown):
                rows.shown = shown
                break
        else:
            rows.shown = rows.new_shown()
            self._pool.append(rows.shown)
        if keep and rows.shown is not before:
            for new, old in zip(cast(Any, rows.shown), before, strict=True):
                new[...] = old


def _count_own() -> int:
    """References to an array that only a Shown tuple holds, as seen from the loop in ``_turn_page``."""
    shown = Shown(*(np.zeros(1) for _ in Shown._fields))  # type: ignore[arg-type]
    return max(sys.getrefcount(array) for array in shown)


_OWN_REFERENCES = _count_own()

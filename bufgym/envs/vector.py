"""``gymnasium.vector.VectorEnv``: n senders stepped by one compiled call, the native form of the environment."""

from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from bufgym.envs.observation import Observation
from bufgym.envs.options import RENDER_MODES, Options, read_arguments
from bufgym.envs.output import BufferPool
from bufgym.envs.sub_envs import SubEnvs, check_entries
from bufgym.model.checks import whole
from bufgym.scenario import Scenario
from bufgym.utils.errors import BufgymError


class SenderVectorEnv(VectorEnv[Observation, NDArray[np.int64], NDArray[Any]]):
    """A batch of n ``SenderEnv``, each with the same actions, observations, rewards, episode ends and arguments.

    With candidates, the default of one queue, actions are int64[n] and observations float32[n, 27]. With slots, an
    observation is a dict of arrays. With several topics some environments may ask what to drop and others what to
    send: the field ``socket_asks`` tells them apart.

    ``num_envs``: n. ``max_episode_steps`` truncates episodes, as Gymnasium's ``TimeLimit`` does.
    ``autoreset_mode``: one of Gymnasium's, or its value or name ("SameStep", "SAME_STEP").
    ``num_threads``: threads that share the environments of a step, by default 1; they do not change results.
    ``arguments``: the others of ``SenderEnv``.

    ``reset(seed=s)`` seeds environment i with s + i, as Gymnasium's own vector environments do. A sequence has a seed
    for each. ``reset`` takes two options. ``reset_mask``, bool[n], selects environments. ``episodes`` has an entry for
    each: an ``Episode``, a dict of the options that name one in ``SenderEnv``, or None to draw the next.

    ``info`` has Gymnasium's form:

    - ``action_mask`` int8[n, actions], and ``slots`` int64[n, actions] of candidates,
    - ``qoi`` float64[n], ``invalid`` int64[n], and ``reward_terms`` by name, float64[n] each.

    Environments that end, truncated ones too, have their summary. With SAME_STEP autoreset ``info`` also has
    ``final_obs`` and ``final_info`` for those that ended, marked in ``info["_final_obs"]``. Arrays from a step are
    never written again while anyone holds them.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        scenario: str | Scenario = "lte",
        capacity: int = Options.capacity,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **arguments: Any,
    ) -> None:
        sub_envs = self._make_sub_envs(whole("num_envs", num_envs, 1), scenario, capacity=capacity, **arguments)
        if max_episode_steps is not None:
            whole("max_episode_steps", max_episode_steps, 1)
        if sub_envs.options.info == "summary":
            raise BufgymError("info = 'summary': is for recorders of a single environment; a batch has 'full'")
        modes = {text: mode for mode in AutoresetMode for text in (mode, mode.value, mode.name)}
        if autoreset_mode not in list(modes):
            known = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise BufgymError(f"autoreset_mode = {autoreset_mode!r}: must be one of {known}")
        self.autoreset_mode = modes[autoreset_mode]
        self.render_mode = sub_envs.options.render_mode
        self._window = sub_envs.options.window()
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.sub_envs, self.num_envs = sub_envs, len(sub_envs)
        self.max_episode_steps = max_episode_steps
        self.single_observation_space = sub_envs.observation_space
        self.single_action_space = sub_envs.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._steps = np.zeros(self.num_envs, np.int64)
        self._done, self._any_done = np.zeros(self.num_envs, np.bool_), False
        self._every = np.ones(self.num_envs, np.bool_)
        self._buffers = BufferPool(self._new_buffers)
        self._renew_output()
        self._generators: list[np.random.Generator | None] = [None] * self.num_envs
        self._seeds: list[int] = [-1] * self.num_envs

    def _make_sub_envs(self, n: int, scenario: Any, **arguments: Any) -> SubEnvs:
        return SubEnvs(n, *read_arguments(scenario, **arguments))

    @property  # type: ignore[misc]
    def np_random(self) -> Any:
        """Each environment's generator, as in Gymnasium's ``SyncVectorEnv``."""
        self._seed_the_rest()
        return tuple(self._generators)

    @property
    def np_random_seed(self) -> Any:
        """Each environment's seed, likewise."""
        self._seed_the_rest()
        return tuple(self._seeds)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        options = {} if options is None else options
        check_entries(options, ("reset_mask", "episodes"), "options")
        seeds = [None] * self.num_envs if seed is None else seed
        if isinstance(seeds, int | np.integer):
            seeds = [int(seeds) + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise BufgymError(f"seed: {len(seeds)} seeds for {self.num_envs} environments")
        mask = np.asarray(options.get("reset_mask", self._every))
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,):  # indices are no mask
            raise BufgymError(f"options['reset_mask'] is {mask.dtype}{[*mask.shape]}: must be bool[{self.num_envs}]")
        if any(self.sub_envs.senders.episodes[i] is None for i in np.flatnonzero(~mask)):
            raise gym.error.ResetNeeded("options['reset_mask'] leaves out environments that have no episode yet")
        self._renew_output(keep=True)
        chosen = np.flatnonzero(mask)
        for i in chosen.tolist():
            if seeds[i] is not None:
                self._seed(i, seeds[i])
        self._seed_the_rest()
        self.sub_envs.reset(chosen, options.get("episodes"))
        self._steps[mask] = 0
        self._done = self._done & ~mask  # a new array: the last step may have returned the old one
        self._any_done = bool(self._done.any())
        if self._window is not None:
            self.render()
        return self._observed(), self._info()

    def step(
        self, actions: NDArray[np.int64] | NDArray[np.floating[Any]]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        sub_envs = self.sub_envs
        actions = sub_envs.actions(actions)
        if sub_envs.senders.episodes[-1] is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        restart = self._any_done and self.autoreset_mode != AutoresetMode.SAME_STEP
        if restart and self.autoreset_mode == AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded("environments have ended: call reset(options={'reset_mask': done}) first")
        self._renew_output()
        sub_envs.step(actions)  # those that have ended stay as they are
        if self.max_episode_steps is not None:
            self._steps += 1
        if restart:
            sub_envs.reset(np.flatnonzero(self._done))
            self._steps[self._done] = 0
        rewards = sub_envs.rewards()
        terminated = sub_envs.output.terminated & ~self._done if restart else sub_envs.output.terminated.copy()
        truncated = np.zeros(self.num_envs, np.bool_)
        if self.max_episode_steps is not None:
            truncated = self._steps >= self.max_episode_steps  # like Gymnasium's TimeLimit, even if the episode ends
        self._done = terminated | truncated
        self._any_done = bool(np.count_nonzero(self._done))
        if self._any_done and self.autoreset_mode == AutoresetMode.SAME_STEP:
            rewards = rewards.copy()  # those that ended begin anew
        info = self._end(self._done) | self._info() if self._any_done else self._info()
        if self._window is not None:
            self.render()
        return self._observed(), rewards, terminated, truncated, info

    def action_masks(self) -> NDArray[np.bool_]:
        """bool[n, actions]: the actions valid now in each environment."""
        return self.sub_envs.action_masks()

    def render(self) -> Any:
        """Each environment as the single environment renders it; with "human" the first 16 in one window, and None."""
        if self.render_mode is None:
            gym.logger.warn(
                "render() needs a render_mode: gym.make_vec(..., render_mode='ansi', 'rgb_array' or 'human')"
            )
            return None
        from bufgym.envs import render  # loaded only to draw

        shown = self.num_envs if self._window is None else min(self.num_envs, render.MOST)
        drawn = tuple(
            render.draw(self.sub_envs.senders, i, self.render_mode, self.sub_envs.output.slot_actions[i])
            for i in range(shown)
        )
        return drawn if self._window is None else self._window.show(drawn, self.metadata["render_fps"])

    def close_extras(self, **_: Any) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _end(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        """The infos of environments that have ended; with SAME_STEP autoreset they begin anew at once."""
        sub_envs = self.sub_envs
        last: dict[str, Any] = {}
        at = np.flatnonzero(done)
        for name, of_ended in sub_envs.summary(at).items():
            column = np.zeros(self.num_envs, of_ended.dtype)
            column[at] = of_ended
            last |= {name: column, f"_{name}": done}
        ended = done & sub_envs.output.terminated
        if sub_envs.options.bound and ended.any():
            for name, column in sub_envs.bounds(ended, sub_envs.output.qoi).items():
                last |= {name: column, f"_{name}": ended}
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            return last
        # As in Gymnasium's SyncVectorEnv: one observation for each that ended, None for the others.
        observations: NDArray[Any] = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(done).tolist():
            observations[i] = sub_envs.observation(i)
        last |= _only(done, self._info())
        sub_envs.reset(np.flatnonzero(done))
        self._steps[done] = 0
        return {"final_obs": observations, "_final_obs": done, "final_info": last, "_final_info": done}

    def _info(self) -> dict[str, Any]:
        """Entries of the info of every step, as far as they were asked for."""
        return {name: entry.copy() if name == "reward_terms" else entry for name, entry in self._shown.items()}

    def _observed(self) -> Observation:
        """The present observation; a dict of its own each time."""
        if self._seen is None:  # chosen numbers of each row, which are a copy
            return self.sub_envs.observation()
        return self._seen.copy() if isinstance(self._seen, dict) else self._seen

    def _new_buffers(self) -> Any:
        """(New arrays for a step, what of them is its observation, its info), and all these arrays."""
        sub_envs, output = self.sub_envs, self.sub_envs.new_output()
        shown: dict[str, Any] = {"action_mask": output.action_mask}
        if sub_envs.choices is not None:
            shown["slots"] = output.slot_actions
        terms = {term.name: output.reward_terms[:, k] for k, term in enumerate(sub_envs.terms)}
        if sub_envs.options.shows_all:
            shown |= {"qoi": output.qoi, "invalid": output.invalid, "reward_terms": self._marked(terms)}
        seen = sub_envs.form.of(output.flat) if sub_envs.form.is_row or sub_envs.form.form == "dict" else None
        views = seen.values() if isinstance(seen, dict) else ()
        return (output, seen, self._marked(shown)), [*output, *views, *terms.values()]

    def _marked(self, columns: dict[str, Any]) -> dict[str, Any]:
        """``columns`` with Gymnasium's marks: every environment has each of them."""
        marked = [((name, column), (f"_{name}", self._every)) for name, column in columns.items()]
        return dict(pair for pairs in marked for pair in pairs)

    def _seed(self, i: int, seed: int | None) -> None:
        """Give environment ``i`` streams of its own, from ``seed``, or from chance if that is None."""
        generator, self._seeds[i] = seeding.np_random(seed)
        self._generators[i] = generator
        self.sub_envs.seed(i, generator)

    def _seed_the_rest(self) -> None:
        for i, generator in enumerate(self._generators):
            if generator is None:
                self._seed(i, None)

    def _renew_output(self, keep: bool = False) -> None:
        """Let the next step write into arrays that nobody outside holds; ``keep`` copies the last step's results."""
        sub_envs, before = self.sub_envs, self.sub_envs.output
        sub_envs.output, self._seen, self._shown = self._buffers.take()
        if keep and sub_envs.output is not before:
            for new, old in zip(cast(Any, sub_envs.output), before, strict=True):
                new[...] = old


def _only(rows: NDArray[np.bool_], info: dict[str, Any]) -> dict[str, Any]:
    """Copy ``info`` for ``rows`` alone, with zeros for the others."""
    own: dict[str, Any] = {}
    for name, column in info.items():
        if name.startswith("_"):
            own[name] = rows
        elif isinstance(column, dict):
            own[name] = _only(rows, column)
        else:
            own[name] = np.where(rows if column.ndim == 1 else rows[:, None], column, 0)
    return own

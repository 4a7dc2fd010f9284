"""Sub-environments whose senders are the robots of cells, and the batch of them from which one shared policy learns."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.options import SLOTS, Options, read_arguments
from bufgym.envs.step import step_cells
from bufgym.envs.sub_envs import SubEnvs
from bufgym.envs.vector import SenderVectorEnv
from bufgym.jit import Repeated
from bufgym.model.checks import whole
from bufgym.scenario import FleetScenario, Uplink
from bufgym.sim.cell import Fleet
from bufgym.utils.errors import BufgymError
from bufgym.utils.threads import Threads


class FleetSubEnvs(SubEnvs):
    """``cells`` cells with N = ``scenario.robots`` robots each. Robot r of cell c is sub-environment c N + r.

    The robots of a cell begin an episode together; it is drawn from the streams of the cell's first robot.
    """

    keeps_slots = True  # for a state of all fields
    own_links = False

    def __init__(self, cells: int, scenario: FleetScenario, options: Options, reward: str) -> None:
        """``reward`` is "team" or "own"; that of ``options`` is its term."""
        if reward not in ("team", "own"):
            raise BufgymError(
                f"reward = {reward!r}: must be 'team' (the mean over the robots) or 'own'; its term is `term`"
            )
        options.check_without_own_link("a cell of robots")
        super().__init__(cells * scenario.robots, cast(Any, scenario), options)
        for name in ("regret", "paired"):
            if name in self._term_names:
                raise BufgymError(f"term {name!r}: known for one queue on a link of its own, not for a cell of robots")
        self.reward, self.robots = reward, scenario.robots
        self.fleet = Fleet(self.senders, scenario.robots)
        self._threads = Threads(np.arange(cells), options.num_threads)
        self._again = [Repeated() for _ in self._threads.parts]

    def seed(self, i: int, rng: np.random.Generator) -> None:
        """Give robot ``i`` streams of its own if it is the first of its cell; the others need none."""
        if i % self.robots == 0:
            super().seed(i, rng)

    def _load(self, rows: NDArray[np.int64], episodes: Sequence[Any] | None) -> NDArray[np.int64]:
        """Load ``episodes[c]``, or the next one drawn where that is None, into each cell of ``rows``."""
        cells = np.unique(rows // self.robots)
        if len(cells) * self.robots != len(rows):
            raise BufgymError("reset_mask: the robots of one cell begin together; give all of them or none")
        if episodes is not None and len(episodes) != len(self.fleet):
            raise BufgymError(f"episodes: {len(episodes)} given for {len(self.fleet)} cells; None where one is drawn")
        for c in cells.tolist():
            episode = episodes[c] if episodes is not None else None
            if episode is None:
                self.fleet.load(c, *self._next_episode(c * self.robots))
                continue
            if not getattr(episode, "ticks_together", True):
                raise BufgymError("episode: in an environment the messages of all robots arrive at the same times")
            self.fleet.load(c, episode)
        return cells

    def _run(self, call: Callable[..., None], rows: NDArray[np.int64], actions: NDArray[np.int64]) -> None:
        call(
            step_cells,
            self.senders.batch,
            self.fleet.shares,
            rows,
            actions,
            self.rewarded,
            self.output,
            self.choices,
            self.form.named,
            self._charges.cost,
        )

    def rewards(self) -> NDArray[np.float64]:
        """float64[n]: each robot's own weighted sum, or for a "team" the mean within its cell."""
        own = super().rewards()
        if self.reward == "own":
            return own
        return np.repeat(own.reshape(len(self.fleet), self.robots).mean(axis=1), self.robots)


def fleet_sub_envs(
    cells: int, scenario: FleetScenario, *, reward: str = "team", term: Any = None, **arguments: Any
) -> FleetSubEnvs:
    """Make the sub-environments of ``cells`` cells from the arguments of a fleet's environment; see ``FleetEnv``."""
    uplink, options = read_arguments(scenario.uplink, reward=term, **{"actions": SLOTS, **arguments})
    return FleetSubEnvs(cells, FleetScenario.of(scenario.robots, cast(Uplink, uplink)), options, reward)


class FleetVecEnv(SenderVectorEnv):
    """``cells`` cells with N ``robots`` each, as a batch of cells x N environments. Robot r of cell c is
    environment c N + r.

    Any learner for one robot thus trains weights that all robots of a fleet share, each deciding from its own
    observation:

        from stable_baselines3 import PPO
        from bufgym.sb3 import GymVecEnv

        rows = FleetVecEnv(cells=1, robots=16, actions="candidates", reward="own", autoreset_mode="SameStep")
        PPO("MlpPolicy", GymVecEnv(rows), n_steps=128, gamma=0.9).learn(150_000)

    **Action, observation, episode end** of each robot and the other arguments are as in ``SenderVectorEnv``, with these
    differences. The robots of a cell begin and end together. ``reset(seed=s)`` seeds cell c with s + c N.
    ``options["episodes"]`` holds a ``FleetEpisode`` for each cell.

    **Reward** "team" gives each robot the mean over its cell of ``term``, the reward of the other environments; "own"
    gives each robot its own. ``info["reward_terms"]`` has each robot's own terms in any case.
    """

    def __init__(
        self,
        cells: int = 1,
        robots: int = 4,
        scenario: str | Uplink | FleetScenario = "lte",
        capacity: int = Options.capacity,
        **arguments: Any,
    ) -> None:
        fleet: Any = FleetScenario.of(robots, scenario)
        super().__init__(whole("cells", cells, 1), fleet, capacity, **arguments)

    def _make_sub_envs(self, n: int, scenario: Any, **arguments: Any) -> SubEnvs:
        return fleet_sub_envs(n, scenario, **arguments)

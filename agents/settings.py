"""The settings of a training run, which are the options of ``train.py``, and the rules they must keep."""

from __future__ import annotations

import math
import shlex
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Literal, NoReturn, get_args, get_origin, get_type_hints

from cyclopts import Parameter
from cyclopts.validators import Number

from bufgym import ENVIRONMENTS
from bufgym.ground.errors import BufgymError
from bufgym.policies.weights import MAX_WIDTH
from bufgym.scenario import Uplink, suites
from bufgym.scenario.uplink import RGBD_BYTES

Kind = Literal["environment", "queue", "topics", "fleet"]
"""The task of a run: one environment, suites of one queue, a suite of many topics, or one of many robots."""

PPO_VALIDATES = 65_536
"""Steps between validations of guided-ppo, two of its updates: it is best within half a million decisions."""
_ALONE = {"topics": ("a scheduler", ("guided",)), "fleet": ("a fleet's agent", ("guided", "maskable-ppo"))}
"""Kinds for one suite alone, with the trained agent and its algorithms."""


def _number(**limits: float) -> Parameter:
    return Parameter(validator=Number(**limits))


Count = Annotated[int, _number(gte=1)]
Natural = Annotated[int, _number(gte=0)]
Share = Annotated[float, _number(gte=0, lte=1)]
Positive = Annotated[float, _number(gt=0, lt=math.inf)]


@dataclass(frozen=True)
class Settings:
    """Train an agent on a bufgym environment, or on a whole suite, and evaluate it on held-out episodes."""

    env: str = "bufgym/Uplink-v0"
    """Gymnasium id."""
    suite: str = ""
    """Train on this suite's train split instead (all its scenarios and capacities at once), keep what is best on its
    validation split, and report on its test split; the agent is asked at every arrival. Several, as in a,b: on all of
    them at once. A suite of many topics (topics-v1) makes a scheduler, one of a fleet (fleet-v1) an agent
    that all its robots share."""
    data: str = ""
    """Folder of recordings, for suites that need one."""
    capacities: str = ""
    """L of a suite's episodes, such as 5,10,25; by default the suite's own."""
    algo: Literal["guided", "guided-ppo", "maskable-ppo", "ppo", "dqn"] = "guided"
    """guided: CMA-ES over whole episodes, on the numbers of a rule (gap-price for one queue). guided-ppo: PPO on the
    same numbers, in an environment. On slots: PPO with action masks, PPO without, and double DQN with masks."""
    beside: bool = True
    """With guided, in an environment: then train guided-ppo for no longer, to compare."""
    name: str = ""
    """Folder under runs/; by default the next free one (with --resume: the last one) of train-1, train-2, ..."""
    resume: bool = False
    """Go on from the run's last checkpoint."""
    seeds: Count = 1
    """Train this many agents, each in a process of its own."""
    backend: Literal["local", "ray", "dask"] = "local"
    """Where the candidates of --algo guided are evaluated: in the seed's process, or on a Ray or Dask cluster, with
    the same result. Its workers must be able to import bufgym and agents."""
    address: str = ""
    """Of the cluster's head, such as tcp://host:8786; by default a cluster on this machine is begun and ended."""
    seed: Annotated[int, _number(gte=0, lt=2**31)] = 0
    """The first seed."""
    steps: Natural = 0
    """Decisions to learn from, for each seed; 0: 40 million for guided, otherwise 1.5 million."""
    capacity: Count = 8
    """L, messages (without a suite)."""
    size_bytes: Count = RGBD_BYTES
    """Mean message size (uplink only)."""
    duration_s: Positive = Uplink.duration_s
    """Length of an episode (uplink only)."""
    decide_at: Literal["overflow", "arrival"] = "overflow"
    """When the agent is asked: only when the buffer is full, or at every arrival."""
    reward: Literal["retained", "delivered"] = "retained"
    network: Literal["slots", "plain"] = "slots"
    """One small network for every slot, or one over all numbers at once."""
    width: Count = 32
    """Hidden units a layer."""
    num_envs: Count = 256
    n_steps: Count = 128
    """Steps in each environment between updates."""
    batch_size: Annotated[int, _number(gte=2)] = 4096
    epochs: Count = 4
    """Passes over each batch of experience."""
    learning_rate: Positive = 2e-3
    """At the start; falls linearly to 0."""
    gamma: Share = 0.9
    """``retained`` pays at once what a decision costs, so a short sight suffices and keeps the noise of motion out."""
    gae_lambda: Share = 0.9
    entropy: Annotated[float, _number(gte=0, lt=math.inf)] = 0.0
    """Weight of the entropy bonus."""
    checkpoint_every: Count = 250_000
    """Steps."""
    validate_every: Natural = 0
    """Steps; 0: a sixth of them, and 65,536 for guided-ppo."""
    validation_episodes: Count = 300
    """About so many in each validation, with a suite over all scenarios and capacities."""
    test_seeds: Annotated[int, _number(gte=0, lte=1000)] = 0
    """Test episodes on each trace of a suite; 0: as many as the suite says."""
    episodes: Count = 200
    """Held-out episodes in the evaluation (without a suite)."""

    @property
    def suites(self) -> tuple[str, ...]:
        """Names in ``suite``."""
        return tuple(filter(None, self.suite.split(",")))

    @property
    def kind(self) -> Kind:
        """The task of the run."""
        kinds = {suites.get(suite).kind for suite in self.suites}
        if not kinds:
            return "environment"
        return "topics" if "topics" in kinds else "fleet" if "fleet" in kinds else "queue"

    @property
    def evolves(self) -> bool:
        """Whether CMA-ES trains the agent."""
        return self.algo == "guided"

    def capacities_of(self, suite: str) -> tuple[int, ...]:
        """L to train for and to test at: the given ones, or the suite's."""
        if not self.capacities:
            return suites.get(suite).capacities
        try:
            capacities = tuple(int(part) for part in self.capacities.split(","))
        except ValueError:
            self._refuse("capacities", "must be whole numbers such as 5,10,25")
        if min(capacities) < 1 or len(set(capacities)) < len(capacities):
            self._refuse("capacities", "must be whole numbers >= 1, no two alike")
        return capacities

    @property
    def command(self) -> str:
        """The command that trains it again, with all settings that differ from the defaults."""
        defaults = asdict(Settings())
        words = [
            f"--{name.replace('_', '-')} {shlex.quote(str(value))}"
            for name, value in asdict(self).items()
            if name not in ("name", "resume", "backend", "address") and value != defaults[name]
        ]
        return " ".join(["python train.py", *words])

    def resolved(self) -> Settings:
        """These settings with the steps that suit the algorithm, where they are left open."""
        steps = self.steps or (40_000_000 if self.evolves else 1_500_000)
        every = PPO_VALIDATES if self.algo == "guided-ppo" else -(-steps // 6)
        return replace(self, steps=steps, validate_every=self.validate_every or every)

    def checked(self) -> Settings:
        """Check these settings and return them; a BufgymError names the first that breaks a rule, and the rule."""
        for name, hint in get_type_hints(Settings, include_extras=True).items():
            value = getattr(self, name)
            for part in getattr(hint, "__metadata__", ()):
                for check in part.validator:
                    try:
                        check(type(value), value)
                    except ValueError as broken:
                        self._refuse(name, str(broken).replace("Must", "must").rstrip("."))
            if get_origin(hint) is Literal and value not in get_args(hint):
                self._refuse(name, f"must be one of {', '.join(get_args(hint))}")
        if self.kind == "environment" and self.env not in ENVIRONMENTS:
            self._refuse("env", f"must be one of {', '.join(ENVIRONMENTS)}")
        if self.kind == "environment" and self.env == "bufgym/Topics-v0":
            self._refuse("env", "a scheduler learns from a suite of topics (--suite topics-v1 --algo guided)")
        if self.algo == "guided-ppo" and self.kind != "environment":
            self._refuse("algo", "PPO on the numbers of a rule learns in an environment, without --suite")
        if self.backend != "local" and not self.evolves:
            self._refuse("backend", "a cluster evaluates the candidates of --algo guided alone")
        if self.address and self.backend == "local":
            self._refuse("address", "is that of a cluster: name its kind (--backend ray or dask)")
        if self.kind in _ALONE:
            agent, algorithms = _ALONE[self.kind]
            if len(self.suites) > 1 or self.algo not in algorithms:
                rule = f"{agent} learns from one suite alone, by --algo {' or '.join(algorithms)}"
                raise BufgymError(f"suite {self.suite}: {rule}")
        if self.kind == "fleet" and self.algo == "maskable-ppo":
            if self.network != "slots":
                self._refuse("network", "a fleet's agent scores slots")
            if self.width > MAX_WIDTH:
                self._refuse("width", f"a fleet's agent has at most {MAX_WIDTH} hidden units a layer")
        if self.kind == "queue":
            self._check_suites()
        if self.capacities:
            self.capacities_of("")
        return self

    def _check_suites(self) -> None:
        """Check the rules of suites of one queue."""
        for name in self.suites:
            suite = suites.get(name)
            suite.settings("validation", self.data or None)  # raises here if recordings are missing

    def _refuse(self, name: str, rule: str) -> NoReturn:
        raise BufgymError(f"{name} = {getattr(self, name)!r}: {rule}")

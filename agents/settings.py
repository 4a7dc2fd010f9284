"""What ``train.py`` can be told: the settings of a training run, and the rules that they keep."""

from __future__ import annotations

import math
import shlex
from dataclasses import asdict, dataclass, fields
from typing import Literal, NoReturn, get_args, get_type_hints

from bufgym import ENVIRONMENTS
from bufgym.errors import BufgymError
from bufgym.policies.learned import MAX_WIDTH, NAMES
from bufgym.scenario import Interruption, suites
from bufgym.scenario.suites import FLEET_SUITES, TOPIC_SUITES

TIME = ("rank", "time_before", "time_merged", "occupancy", "stalled", "service_ratio")
"""Fields that a queue and a clock can tell, as AFR's."""

MOTION = (
    *("rank", "motion_before", "motion_merged", "loss", "relative_loss"),
    *("occupancy", "stalled", "service_ratio", "even_value", "bend"),
)
"""Fields with odometry and V."""

SEES = {"time": TIME, "motion": MOTION}

Kind = Literal["environment", "queue", "topics", "fleet"]
"""What a run trains on: one environment, suites of one queue, a suite of many topics, or one of many robots."""

_INFINITY = math.inf
_LEAST_1 = "seeds steps capacity size_bytes width num_envs n_steps epochs checkpoint_every validate_every"
_RANGES: dict[str, tuple[float, float]] = {
    **dict.fromkeys(_LEAST_1.split(), (1, _INFINITY)),
    **dict.fromkeys(("validation_episodes", "episodes"), (1, _INFINITY)),
    **dict.fromkeys(("warm_up", "entropy"), (0, _INFINITY)),
    **dict.fromkeys(("hidden", "still_hidden"), (0, MAX_WIDTH)),
    **dict.fromkeys(("gamma", "gae_lambda"), (0, 1)),
    "batch_size": (2, _INFINITY),
    "seed": (0, 2**31 - 1),
    "test_seeds": (0, 1000),
}
"""Setting -> the smallest and the largest value it may have."""
_POSITIVE = ("duration_s", "learning_rate")


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
    algo: Literal["maskable-ppo", "ppo", "dqn", "evolution"] = "maskable-ppo"
    """PPO with action masks, PPO without, double DQN with masks, or CMA-ES over whole episodes (suites only)."""
    sees: Literal["motion", "time"] = "motion"
    """What an evolved agent sees: odometry as well, or the clock alone."""
    fields: str = ""
    """Fields that an evolved agent reads, such as rank,motion_merged,stalled; by default those of --sees."""
    hidden: int = 0
    """Hidden units of an evolved agent; with none, its scores are linear in what the context makes of the slots."""
    still_hidden: int = 6
    """The same for its scorer of links that stand still (``warm_up``)."""
    name: str = ""
    """Folder under runs/; by default the next free one (with --resume: the last one) of train-1, train-2, ..."""
    resume: bool = False
    """Go on from the run's last checkpoint."""
    seeds: int = 1
    """Train this many agents, each in a process of its own."""
    seed: int = 0
    """The first seed."""
    steps: int = 1_500_000
    """Decisions to learn from, for each seed."""
    capacity: int = 8
    """L, messages (without a suite)."""
    size_bytes: int = 500_000
    """Mean message size (uplink only); 500 kB at 30 Hz is 1.5 times what the shipped traces carry."""
    duration_s: float = 30.0
    """Length of an episode (uplink only)."""
    decide_at: Literal["overflow", "arrival"] = "overflow"
    """When the agent is asked: only when the buffer is full, or at every arrival."""
    reward: Literal["retained", "delivered"] = "retained"
    network: Literal["slots", "plain"] = "slots"
    """One small network for every slot, or one over all numbers at once."""
    width: int = 32
    """Hidden units a layer."""
    num_envs: int = 256
    n_steps: int = 128
    """Steps in each environment between updates."""
    batch_size: int = 4096
    epochs: int = 4
    """Passes over each batch of experience."""
    learning_rate: float = 2e-3
    """At the start; falls linearly to 0."""
    gamma: float = 0.9
    """``retained`` pays at once what a decision costs, so a short sight suffices and keeps the noise of motion out."""
    gae_lambda: float = 0.9
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    warm_up: int = 0
    """Decisions for which evolution first learns a scorer of its own for links that stand still, from interruptions
    alone (their mean over T is exact and cheap); afterwards the one for all other links, from the other suites."""
    checkpoint_every: int = 250_000
    """Steps."""
    validate_every: int = 250_000
    """Steps (with a suite)."""
    validation_episodes: int = 300
    """About so many in each validation, over all scenarios and capacities."""
    test_seeds: int = 0
    """Test episodes on each trace of a suite; 0: as many as the suite says."""
    episodes: int = 200
    """Held-out episodes in the evaluation (without a suite)."""

    @property
    def suites(self) -> tuple[str, ...]:
        """Those that ``suite`` names."""
        return tuple(filter(None, self.suite.split(",")))

    @property
    def kind(self) -> Kind:
        """What the run trains on."""
        if not self.suites:
            return "environment"
        if any(suite in TOPIC_SUITES for suite in self.suites):
            return "topics"
        return "fleet" if any(suite in FLEET_SUITES for suite in self.suites) else "queue"

    def capacities_of(self, suite: str) -> tuple[int, ...]:
        """L to train for and to test at: those given, or the suite's."""
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
    def observed(self) -> tuple[str, ...]:
        """Fields that an evolved agent reads."""
        return tuple(self.fields.split(",")) if self.fields else SEES[self.sees]

    @property
    def command(self) -> str:
        """The command that trains it again: the settings that differ from the defaults."""
        defaults = asdict(Settings())
        words = [
            f"--{name.replace('_', '-')} {shlex.quote(str(value))}"
            for name, value in asdict(self).items()
            if name not in ("name", "resume") and value != defaults[name]
        ]
        return " ".join(["python train.py", *words])

    def checked(self) -> Settings:
        """These settings, or a BufgymError that names the first one that breaks a rule, and the rule."""
        hints = get_type_hints(Settings)
        for setting in fields(self):
            value, choices = getattr(self, setting.name), get_args(hints[setting.name])
            low, high = _RANGES.get(setting.name, (-_INFINITY, _INFINITY))
            if choices and value not in choices:
                self._refuse(setting.name, f"must be one of {', '.join(choices)}")
            if isinstance(value, float) and not math.isfinite(value):
                self._refuse(setting.name, "must be a finite number")
            if isinstance(value, int | float) and not low <= value <= high:
                self._refuse(setting.name, f"must be >= {low}" if high == _INFINITY else f"must lie in {low}..{high}")
            if setting.name in _POSITIVE and value <= 0:
                self._refuse(setting.name, "must be > 0")
        if self.kind == "environment":
            if self.env not in ENVIRONMENTS:
                self._refuse("env", f"must be one of {', '.join(ENVIRONMENTS)}")
            if self.algo == "evolution":
                raise BufgymError("--algo evolution learns from a suite's episodes: name one (--suite)")
        elif self.kind == "topics":
            if len(self.suites) > 1 or self.algo != "evolution":
                suite = next(suite for suite in self.suites if suite in TOPIC_SUITES)
                raise BufgymError(f"suite {suite}: a scheduler learns from one suite alone, by --algo evolution")
        elif self.kind == "fleet":
            if len(self.suites) > 1 or self.algo not in ("evolution", "maskable-ppo"):
                suite = next(suite for suite in self.suites if suite in FLEET_SUITES)
                message = "a fleet's agent learns from one suite alone, by evolution or maskable-ppo"
                raise BufgymError(f"suite {suite}: {message}")
            if self.algo == "maskable-ppo" and self.network != "slots":
                self._refuse("network", "a fleet's agent scores slots")
            if self.algo == "maskable-ppo" and self.width > MAX_WIDTH:
                self._refuse("width", f"a fleet's agent has at most {MAX_WIDTH} hidden units a layer")
        else:
            self._check_suites()
        if self.capacities:
            self.capacities_of("")
        if self.algo == "evolution" or self.fields:
            self._check_fields()
        return self

    def _check_fields(self) -> None:
        """The rule of what an evolved agent reads."""
        known = [name for name in self.observed if name in NAMES]
        merged = {"motion_merged", "time_merged"} & set(known)
        if len(set(known)) < len(self.observed) or not merged or "rank" not in known:
            rule = "must be rank, motion_merged or time_merged, and others of the observation's, each once"
            self._refuse("fields", f"{rule} (bufgym list observations)")

    def _check_suites(self) -> None:
        """The rules of suites of one queue."""
        interruptions = False
        for name in self.suites:
            suite = suites.get(name)
            suite.settings("validation", self.data or None)  # an error here where recordings are missing
            settings = suite.settings("train", self.data or None).values()
            interruptions |= any(isinstance(setting.scenario, Interruption) for setting in settings)
        if self.warm_up and not interruptions:
            self._refuse("warm_up", "needs a suite of interruptions")

    def _refuse(self, name: str, rule: str) -> NoReturn:
        raise BufgymError(f"{name} = {getattr(self, name)!r}: {rule}")

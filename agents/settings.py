"""The settings of training runs, which are the options of ``train.py``: a class for each algorithm.

The types hold the limits of single options, which are read from text once, and each class the rules of its own. What
few change (``NO_OPTION``) is set in Python alone, as in ``PPO(n_steps=128)``.
"""

from dataclasses import dataclass, is_dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, get_type_hints

from cyclopts import Parameter

from agents.tasks import NO_OPTION, Environment, Families, Kind, Names, Place, Suites
from bufgym.cli.options import Count, Natural, Positive, checked, command_line
from bufgym.policies.weights import MAX_WIDTH
from bufgym.utils.errors import BufgymError

FLAT = Parameter(name="*")
VALIDATIONS = 300
"""Episodes of a validation in an environment and on suites of one queue."""

Seed = Annotated[int, checked(int, lambda number: 0 <= number < 2**31, "a whole number >= 0 and < 2^31")]
Batch = Annotated[int, checked(int, lambda number: number >= 2, "a whole number >= 2")]
Share = Annotated[float, checked(float, lambda number: 0 <= number <= 1, "a number from 0 to 1")]


def options_of(settings: Any) -> dict[str, Any]:
    """Option -> value, also of the settings within these."""
    found: dict[str, Any] = {}
    kinds = get_type_hints(type(settings), include_extras=True)
    for name, value in vars(settings).items():
        if is_dataclass(value):
            found |= options_of(value)
        elif NO_OPTION not in getattr(kinds[name], "__metadata__", ()):
            found[name] = value
    return found


@dataclass(frozen=True)
class RunSettings:
    """What all runs share."""

    algo: ClassVar[str]
    """The command of ``train.py``, which names the agents in tables too."""
    steps: Natural
    validate_every: Natural = 0
    """Steps; 0: a sixth of them."""
    name: str = ""
    """Folder under runs/; by default the next free one (with --resume: the last one) of train-1, train-2, ..."""
    resume: bool = False
    """Go on from the run's last checkpoint."""
    seed: Seed = 0
    """The first seed."""

    @property
    def verb(self) -> str:
        """Its command of ``train.py``, with what is typed by place."""
        return self.algo

    @property
    def every(self) -> int:
        """Steps between validations."""
        return self.validate_every or -(-self.steps // 6)

    @property
    def values(self) -> dict[str, Any]:
        """Every option with its value."""
        found: dict[str, Any] = {}
        for name, value in vars(self).items():
            found |= vars(value) if is_dataclass(value) else {name: value}
        return found

    @property
    def command(self) -> str:
        """The command that trains it again, with all options that differ from the defaults."""
        usual, beside = type(self)().values, ("name", "resume")  # type: ignore[call-arg]
        changed = {name: v for name, v in options_of(self).items() if name not in beside and v != usual[name]}
        return command_line(f"python train.py {self.verb}", **changed)


@dataclass(frozen=True)
class Settings(RunSettings):
    """What all algorithms share."""

    learner: ClassVar[str]
    """Its ``agents.learner.Learner`` as module:class, imported once the settings are known to be good."""
    kinds: ClassVar[tuple[Kind, ...]] = ("environment",)
    """The tasks it can learn."""
    validation_episodes: Natural = 0
    """About so many in each validation, over all scenarios and capacities; 0: 300, or 4 for each link of a fleet."""
    environment: Annotated[Environment, FLAT] = Environment()
    suites: Annotated[Suites, FLAT] = Suites()
    seeds: Count = 1
    """Train this many agents, each in a process of its own."""

    def __post_init__(self) -> None:
        if self.suites.suite and self.environment != type(self.environment)():
            raise BufgymError("--suite: it has environments of its own, so no setting of one (--env, --capacity, ...)")
        if self.suites.data and self.kind == "environment":
            raise BufgymError("--data is of suites and of the family uplinks")
        if self.kind not in self.kinds:
            known = ", ".join(each.algo for each in ALGORITHMS if self.kind in each.kinds) or "tune RULE --on SUITE"
            raise BufgymError(f"suite {self.suites.suite[0]}: {self.algo} learns none of this kind; these do: {known}")

    @property
    def on(self) -> Environment | Suites:
        """What it trains on."""
        return self.suites if self.suites.suite else self.environment

    @property
    def kind(self) -> Kind:
        """The task of the run."""
        return self.on.kind

    def validations(self, usual: int = VALIDATIONS, cells: int = 1) -> int:
        """Episodes of a validation in each of so many cells."""
        return max(1, round(self.validation_episodes / cells)) if self.validation_episodes else usual


@dataclass(frozen=True)
class Tune(RunSettings):
    """Search a rule's named numbers by CMA-ES over whole episodes; the result is its name with its settings."""

    algo = "tune"
    rule: Annotated[str, NO_OPTION] = ""
    """The policy, as in bench."""
    parameters: Names = ()
    """Search these alone, as in pace,discount (default: all)."""
    steps: Natural = 100_000_000
    """Decisions to search by; a rule takes .1 to .6 us for each."""
    place: Annotated[Place, FLAT] = Place()
    policy_file: str | None = None
    """Python file that registers policies of your own; its code is run, so use only files you trust."""

    @property
    def verb(self) -> str:
        """With the rule, which has no option."""
        return f"{self.algo} {self.rule}"


@dataclass(frozen=True)
class SingleDecisions(Settings):
    """What algorithms share that choose among ordered candidates at a full buffer, by the library's own settings."""

    kinds = ("environment", "queue", "fleet")
    steps: Natural = 200_000
    """Decisions to learn from, for each seed."""
    reward: Literal["regret", "paired", "cost", "retained"] = "regret"
    """regret knows the future, which only the reward does; it needs messages of equal size, and no fleet. paired is for
    any sizes, and no fleet either."""
    candidates: Annotated[int, NO_OPTION] = 2
    """k: how many of the cheapest candidates the agent chooses among, beside the head."""
    width: Count = 64
    """Hidden units of both layers."""
    num_envs: Count = 8
    """Environments side by side; a fleet's robots in whole cells."""
    batch_size: Batch = 64
    """Decisions of one gradient step."""
    learning_rate: Positive = 3e-4
    gamma: Share = 0.99
    checkpoint_every: Annotated[int, NO_OPTION] = 50_000
    """Steps."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind == "fleet" and self.reward in ("regret", "paired"):
            raise BufgymError(
                f"suite {self.suites.suite[0]}: nobody knows the {self.reward} of robots that share a link: give "
                "--reward retained --gamma 0.5"
            )
        if self.width > MAX_WIDTH:
            raise BufgymError(f"width = {self.width}: a file of weights has at most {MAX_WIDTH} hidden units a layer")


@dataclass(frozen=True)
class PPO(SingleDecisions):
    """Train by stable-baselines3's PPO, with its own settings, among ordered candidates."""

    algo = "ppo"
    learner = "agents.ppo:CandidatePPO"
    n_steps: Annotated[int, NO_OPTION] = 256
    """Steps in each environment between updates: with 8, as many decisions an update as the library has with one."""
    epochs: Annotated[int, NO_OPTION] = 10
    """Passes over the decisions of an update."""
    gae_lambda: Annotated[float, NO_OPTION] = 0.95
    entropy: Annotated[float, NO_OPTION] = 0.0
    """Weight of the entropy bonus."""


@dataclass(frozen=True)
class DQN(SingleDecisions):
    """Train by stable-baselines3's DQN, with its own settings, among ordered candidates."""

    algo = "dqn"
    learner = "agents.ppo:CandidateDQN"
    num_envs: Count = 1
    """Environments side by side; a fleet's robots in whole cells."""
    batch_size: Batch = 32
    """Decisions of one gradient step."""
    learning_rate: Positive = 1e-4
    train_freq: Annotated[int, NO_OPTION] = 4
    """Steps in each environment between updates."""
    gradient_steps: Annotated[int, NO_OPTION] = 1
    """Gradient steps of an update."""
    buffer_size: Annotated[int, NO_OPTION] = 200_000
    """Decisions in the replay, all of a run's; they take 45 MB."""
    learning_starts: Annotated[int, NO_OPTION] = 100
    """Decisions before the first update."""
    target_update_interval: Annotated[int, NO_OPTION] = 10_000
    """Decisions between two copies of the network to the target network."""


@dataclass(frozen=True)
class Hindsight(Settings):
    """Learn from the clairvoyant what each decision costs, among ordered candidates; messages of equal size."""

    algo = "hindsight"
    learner = "agents.hindsight:HindsightLearner"
    kinds = ("environment", "queue", "families")
    steps: Natural = 300_000
    """Decisions to learn from, for each seed."""
    sets: Annotated[Families, FLAT] = Families()
    candidates: Annotated[int, NO_OPTION] = 0
    """k: how many of the cheapest candidates the agent chooses among, beside the head and accepting; 0: 2 in an
    environment, else 3."""
    width: Count = 64
    """Hidden units of both layers."""
    num_envs: Natural = 0
    """Environments side by side, a sixth of which the rule plays; 0: 128 in an environment, else 384."""
    batch_size: Natural = 0
    """Decisions of one gradient step; 0: 1024 in an environment, else 2560."""
    gradient_steps: Annotated[int, NO_OPTION] = 2
    """Gradient steps after each decision of all environments."""
    learning_rate: Positive = 2e-3
    """At the start; falls linearly to a twentieth."""
    entropy: Annotated[float, NO_OPTION] = 0.3
    """Bonus for entropy at the start, in units of what action 0 costs; falls to 0 by half time. In an environment there
    is none."""
    room: Annotated[int, NO_OPTION] = 400_000
    """Decisions kept to learn from; they take about 60 MB."""
    checkpoint_every: Annotated[int, NO_OPTION] = 100_000
    """Steps."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sets.families and (self.suites.suite or self.environment != type(self.environment)()):
            raise BufgymError("--families: they have links of their own, so no suite and no setting of an environment")

    @property
    def kind(self) -> Kind:
        """The task of the run."""
        return self.sets.kind if self.sets.families else super().kind

    @property
    def resolved(self) -> "Hindsight":
        """The same without zeros that stand for numbers by the task."""
        usual: dict[str, Any] = {"candidates": 2, "num_envs": 128, "batch_size": 1024}
        if self.kind != "environment":
            usual = {"candidates": 3, "num_envs": 384, "batch_size": 2560}
        return replace(self, **{name: getattr(self, name) or number for name, number in usual.items()})


ALGORITHMS: tuple[type[Settings], ...] = (PPO, DQN, Hindsight)
"""Commands of ``train.py``. A new learner is a file with a ``Learner`` (``agents.learner``) and an entry here."""

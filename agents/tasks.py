"""What a training run learns on: one environment, or whole suites; each with its options of ``train.py``."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from cyclopts import Parameter

from bufgym.benchmark.own_suite import suite_named
from bufgym.cli.options import Capacities, Count, checked
from bufgym.scenario import Uplink, suites
from bufgym.scenario.uplink import RGBD_BYTES
from bufgym.utils.errors import BufgymError, unknown

Kind = Literal["environment", "queue", "families", "topics", "fleet"]
"""The task of a run: one environment, suites of one queue, families of links, a suite of many topics, or of robots."""

_KINDS: dict[str, Kind] = {"topics": "topics", "fleet": "fleet"}
Names = Annotated[tuple[str, ...], checked(lambda text: tuple(text.split(",")), all, "names such as lte-v1,outage-v1")]


NO_OPTION = Parameter(parse=False)
"""A setting in Python that is no option of ``train.py``."""


@dataclass(frozen=True)
class Environment:
    """One environment to train in."""

    kind: ClassVar[Kind] = "environment"
    env: Literal["bufgym/Uplink-v1", "bufgym/Interruption-v1"] = "bufgym/Uplink-v1"
    """Gymnasium id."""
    capacity: Count = 8
    """L, messages."""
    size_bytes: Annotated[int, NO_OPTION] = RGBD_BYTES
    """Mean message size (uplink only)."""
    duration_s: Annotated[float, NO_OPTION] = Uplink.duration_s
    """Length of an episode, s (uplink only)."""
    episodes: Count = 200
    """Held-out episodes in the evaluation."""

    def __post_init__(self) -> None:
        if "Uplink" not in self.env and (self.size_bytes, self.duration_s) != (RGBD_BYTES, Uplink.duration_s):
            raise BufgymError(f"{self.env}: its messages have no size and its episodes no length to set")


@dataclass(frozen=True)
class Suites:
    """Suites to train on instead of an environment."""

    suite: Names = ()
    """Train on this suite's train split instead (all its scenarios and capacities at once), keep what is best on its
    validation split, and report on its test split. Several, as in a,b: on all of them at once. A suite of a fleet
    (fleet-v1) makes an agent that all its robots share. module:NAME is your own bufgym.suite(...); its code is run."""
    data: str | None = None
    """Folder of recordings, for suites that need one, and for the family uplinks."""
    capacities: Annotated[tuple[int, ...], NO_OPTION] = ()
    """L of a suite's episodes; by default the suite's own."""
    test_seeds: Annotated[int, NO_OPTION] = 0
    """Test episodes on each trace of a suite; 0: as many as the suite says."""

    def __post_init__(self) -> None:
        if len(self.suite) > 1 and {"topics", "fleet"} & {suites.get(name).kind for name in self.names}:
            raise BufgymError(
                f"suite {','.join(self.suite)}: an agent for topics or a fleet learns from one suite alone"
            )
        for name in self.names:
            suites.get(name).settings("validation", self.data)  # raises here if recordings are missing

    @property
    def names(self) -> tuple[str, ...]:
        """The suites by name, one's own after its module was imported, in each process."""
        return tuple(map(suites.named, self.suite))

    @property
    def kind(self) -> Kind:
        """The task of its suites."""
        return _KINDS.get(suites.get(self.names[0]).kind, "queue")

    def capacities_of(self, suite: str) -> tuple[int, ...]:
        """L to train for and to test at: the given ones, or the suite's."""
        return self.capacities or suites.get(suite).capacities


FAMILY_NAMES = ("task", "frames", "lte", "generated", "outage", "heavy", "light", "random", "uplinks")
ALL, RECORDED = "all", "uplinks"


@dataclass(frozen=True)
class Families:
    """Families of links to train on instead of an environment."""

    kind: ClassVar[Kind] = "families"
    families: Names = ()
    """Train on these families of links and streams side by side instead (agents/ready_families.py), as in task,lte;
    all: on all of them, on uplinks if there is --data. What is best on
    their validation links is kept, and the report has their test links."""

    def __post_init__(self) -> None:
        for name in self.families:
            if name not in (ALL, *FAMILY_NAMES):
                raise unknown("family", name, (ALL, *FAMILY_NAMES))

    def named(self, data: str | None) -> tuple[str, ...]:
        """The families, each once; all are those that need no recordings, and with ``data`` the others."""
        here = FAMILY_NAMES if data else tuple(name for name in FAMILY_NAMES if name != RECORDED)
        return here if ALL in self.families else tuple(dict.fromkeys(self.families))


@dataclass(frozen=True)
class Place:
    """What a rule is tuned on."""

    on: str = ""
    """A scenario or a suite (default: lte): a name (bufgym list), as in lte:rate_hz=5, a client's .toml, or
    module:NAME."""
    workload: str | None = None
    """A recording of a robot's messages in place of a scenario, as in bench."""
    trace: Names = ()
    """Bandwidth traces for it, as in bench (default: shipped LTE)."""
    data: str | None = None
    """Folder of recordings, for suites that need one."""
    capacity: Capacities = ()
    """L, such as 5,10,25 (default: 8, with topics 32, or the suite's)."""

    def __post_init__(self) -> None:
        if not self.on and self.workload is None:
            object.__setattr__(self, "on", "lte")
        is_suite = bool(suite_named(self.on))
        if is_suite and (self.workload is not None or self.trace):
            raise BufgymError(f"suite {self.on}: has streams and links of its own, so no --workload and no --trace")
        if self.data is not None and (not is_suite or self.workload is not None):
            raise BufgymError("--data is of a suite, which --on names")
        if self.on and self.workload is not None:
            raise BufgymError(f"--workload {self.workload} takes the place of --on {self.on}: must be one of them")

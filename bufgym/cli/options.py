"""What commands share: types and groups of options, what goes together, policies by name and from files, columns."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from cyclopts import Group, Parameter

from bufgym.utils import modules
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library
from bufgym.utils.tables import aligned
from bufgym.utils.units import bytes_of, rate_of

if TYPE_CHECKING:
    from bufgym.benchmark.tasks import Task
    from bufgym.policies import Policy

MAX_EPISODES = 100_000  # Limit on episodes of each trace; memory holds a row for each, times policies and capacities

OPTIONS = Parameter(
    consume_multiple=(1, None),
    allow_repeating=True,
    negative="",
    show_default=lambda value: None if value is False or value == "" else value,
)
"""How all options are: a list takes one word or more, the last of two equal ones counts, and none has a --no-option."""


def checked(
    convert: Callable[[str], Any], holds: Callable[[Any], bool], rule: str, *, several: bool = False
) -> Parameter:
    """The type of an option: ``convert`` reads the text, ``holds`` tests the value, errors name ``rule``.

    With ``several`` it takes one word or more, read as one text with commas between them.
    """

    def parse(_: Any, tokens: Sequence[Any]) -> Any:
        text = ",".join(token.value for token in tokens)
        try:
            value = convert(text)
        except ValueError:
            value = None
        if value is None or not holds(value):
            option = "" if len(tokens) == 1 else f"{tokens[0].keyword} "  # named by the caller for a single word
            raise ValueError(f"{option}{text}: must be {rule}")
        return value

    words: dict[str, Any] = {"n_tokens": -1} if several else {"n_tokens": 1, "consume_multiple": False}
    return Parameter(converter=parse, accepts_keys=False, **words)


Whole = Annotated[int, checked(int, lambda number: True, "a whole number")]
Count = Annotated[int, checked(int, lambda number: number >= 1, "a whole number >= 1")]
Bytes = Annotated[
    int, checked(bytes_of, lambda number: number >= 1, "a whole number of bytes >= 1, as in 230000, 1e6 or 4.6MB")
]
Holes = Literal["hold", "zero", "refuse"]
_RATE = "bytes/s > 0, or as in 20Mbit/s"
Rate = Annotated[float, checked(lambda text: rate_of(text) or float(text), lambda rate: 0 < rate < math.inf, _RATE)]
Natural = Annotated[int, checked(int, lambda number: number >= 0, "a whole number >= 0")]
PortNumber = Annotated[int, checked(int, lambda number: 0 <= number < 2**16, "a whole number from 0 to 65535")]
Seeds = Annotated[
    int, checked(int, lambda number: 1 <= number <= MAX_EPISODES, f"a whole number >= 1 and at most {MAX_EPISODES}")
]
Positive = Annotated[float, checked(float, lambda number: 0 < number < math.inf, "a number > 0")]
PerSecond = Annotated[float, checked(float, lambda rate: 0.01 <= rate <= 1000, "a number from 0.01 to 1000")]
Least0 = Annotated[float, checked(float, lambda number: 0 <= number < math.inf, "a number >= 0")]
Capacities = Annotated[
    tuple[int, ...],
    checked(
        lambda text: tuple(map(int, text.split(","))),
        lambda Ls: min(Ls) >= 1 and len(set(Ls)) == len(Ls),
        "whole numbers >= 1, no two alike",
        several=True,
    ),
]
"""Distinct integers, as in ``4,8,16`` or ``4 8 16``."""
PolicyFile: TypeAlias = Annotated[
    str | None,
    Parameter(help="Python file that registers policies of your own; its code is run, so use only files you trust"),
]
"""The option ``--policy-file``; ``load_policies`` runs the file."""


@Parameter(name="*", group=Group.create_ordered("A suite: frozen episodes, scored, with a report"))
@dataclass(frozen=True)
class SuiteOptions:
    suite: str | None = None
    """Which ('bufgym list suites'), or module:NAME, your own bufgym.suite(...), whose code is run; --out DIR keeps it,
    a second call resumes it."""
    split: str | None = None
    """train, validation or test (default: test)."""
    data: str | None = None
    """Folder of recordings, for suites over real links."""
    jobs: Whole | None = None
    """Processes side by side, -1 for one a core (default: a suite one a core, any other one)."""
    backend: str | None = None
    """loky (default), threading, sequential, ray or dask (on the cluster of RAY_ADDRESS or DASK_SCHEDULER_ADDRESS, else
    on this machine)."""


@Parameter(name="*", group=Group.create_ordered("Who runs"))
@dataclass(frozen=True)
class WhoOptions:
    policies: list[str] | None = None
    """Policies, as in afr,decimate:every=2 (default: all that the task takes); also mine.safetensors,
    mine.zip of stable-baselines3 or sb3-contrib, and module:function (a policy, or what makes one; from the current
    folder too): a zip and a module run code, so use only what you trust."""
    capacity: Capacities | None = None
    """Capacities L, messages, as in 4,8,16 or 4 8 16 (default: 8; topics: 32; or the suite's)."""
    seeds: Seeds | None = None
    """Episodes on each trace (default: 10; topics: 5; a recording: 1; or the suite's)."""
    policy_file: PolicyFile = None
    against: str | None = None
    """Compare every policy with this one, by the paired difference of their shares of AFR's regret (of QoI over
    Robofleet's with topics, of the gain over AFR with a fleet)."""

    def entrants(self, task: Task) -> list[Policy]:
        """The policies of ``--policies``, or those that the task takes."""
        return policies_of(self.policies or task.default_policies())

    def rival(self) -> Policy | None:
        """The policy of ``--against``."""
        return None if self.against is None else one_policy(self.against)


RESULTS = Group.create_ordered("Where results go", sort_key=1)


@Parameter(name="*", group=RESULTS)
@dataclass(frozen=True)
class OutOptions:
    out: str | None = None
    """Write rows and what was run into this folder, or rows alone into this .csv or .parquet file."""
    format: Literal["csv", "parquet"] | None = None
    """Format of the rows (default: parquet if it can)."""
    report: str | None = None
    """Write the page to this HTML file: ranking with intervals, charts, one episode (extra 'report')."""
    by_topic: str | None = None
    """With several topics: print each topic's numbers under this policy."""

    def file(self) -> Path | None:
        """The file of ``--out``; None for a folder or nothing. Another kind of file is an error."""
        from bufgym.benchmark.rows import checked_target

        if self.format == "parquet" and self.out is not None:
            library("pyarrow", "bench", "--format parquet, unlike csv,")
        if self.out is None or not Path(self.out).suffix[1:].isalpha() or Path(self.out).is_dir():
            return None
        file = checked_target(self.out)
        if not file.absolute().parent.is_dir():
            raise BufgymError(f"{self.out}: no folder to write this file to")
        return file

    def page(self) -> Path | None:
        """The file of ``--report``; None without. What could not be written in the end is an error now."""
        if self.report is None:
            return None
        library("jinja2", "report", "the report")
        library("matplotlib", "report", "the report")
        file = Path(self.report)
        if file.is_dir() or file.suffix != ".html" or not file.absolute().parent.is_dir():
            raise BufgymError(f"--report {self.report}: must be FILE.html in a folder that there is")
        return file

    def topic_policy(self, task: Task, players: Sequence[Policy]) -> str | None:
        """The name of ``--by-topic``; an error if that policy does not run, or not on several topics."""
        from bufgym.policies import get

        if self.by_topic is None:
            return None
        if task.kind != "topics":
            raise BufgymError("--by-topic needs several topics")
        name = get(self.by_topic).name
        if name not in {task.baseline, *(policy.name for policy in players)}:
            raise BufgymError(f"--by-topic {self.by_topic}: not among the policies that run")
        return name

    def folder(self) -> Path | None:
        """The folder of ``--out``; None for a file or nothing."""
        return None if self.out is None or self.file() is not None else Path(self.out)


def given(options: object, *names: str) -> dict[str, Any]:
    """Select the options of a group that the user gave; ``names``: among these alone."""
    return {
        name: value
        for name, value in vars(options).items()
        if value is not None and value is not False and (not names or name in names)
    }


def refuse(options: Mapping[str, Any], why: str) -> None:
    """Raise the error ``--name why`` for the first of these options."""
    for name in options:
        raise BufgymError(f"{_flag(name)} {why}")


def command_line(command: str, **options: Any) -> str:
    words = [command]
    for name, value in options.items():
        if value is not None and value is not False:
            text = ",".join(map(str, value)) if isinstance(value, tuple) else value
            parts = [] if value is True else text if isinstance(text, list) else [text]
            words += [_flag(name), *(shlex.quote(str(part)) for part in parts)]
    return " ".join(words)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def policy_specs(texts: Sequence[str] | None) -> list[str]:
    """List the policies of ``--policies``, separated by commas or spaces; empty if it was not given.

    A setting belongs to the policy before it, as in ``afr,red:min_th=1,max_th=2,random``.
    """
    specs: list[str] = []
    for text in texts or ():
        for k, part in enumerate(text.split(",")):
            if k and "=" in part and ":" not in part:
                specs[-1] += f",{part}"
            else:
                specs.append(part.strip())
    return specs


def policies_of(texts: Sequence[str] | None) -> list[Policy]:
    """The policies of ``--policies``; those from files and modules are loaded."""
    from bufgym.benchmark.sources import make_policy

    words = policy_specs(texts)
    for word in words:
        if word.endswith(".py"):
            raise BufgymError(f"--policies {word}: a Python file; --policy-file {word} registers its policies")
    return [make_policy(word) for word in words]


def one_policy(text: str, file: str | None = None) -> Policy:
    """The single policy of ``--policies``, after the user's file was run."""
    load_policies(file)
    policies = policies_of([text])
    if len(policies) != 1:
        raise BufgymError(f"--policies {text}: must be one policy")
    return policies[0]


def load_policies(path: str | None) -> None:
    """Run the user's Python file, which registers policies."""
    if path is not None:
        modules.run_file(path, "--policy-file")


def columns(lines: Sequence[Sequence[str]]) -> str:
    """Align columns to the left, indented."""
    return "\n".join(f"  {line}" for line in aligned(lines, left=max(map(len, lines), default=0)))

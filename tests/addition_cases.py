"""Files and lines of each row of the table of docs/where-to-add.md, which the tests add to a copy of the sources."""

import os
import shutil
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

REPO = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Addition:
    """What a row of the table adds."""

    files: dict[str, str]
    """New file -> its text."""
    lines: dict[str, tuple[str, str]]
    """File -> (text that is there once, the same text with what is added)."""
    use: str
    """A program that uses it, and fails without it."""


RULE = '''
@built_in("newest-two", source="this test")
def newest_two(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Keep the newest two."""
    return keep_last(buffer, arrival, 2)
'''
STEADY = '''
import numpy as np

from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario.arrivals import messages
from bufgym.scenario.episode import Episode, Streams
from bufgym.traces import Trace


class Halves:
    """A message every second over a link that carries one in two."""

    value, topics, max_messages = qoi.exponential(), (), 20

    def draw(self, streams: Streams) -> Episode:
        return Episode(messages(np.arange(20) * 1_000_000, 1000), Link(Trace.steps([(60.0, 500.0)])))
'''
SUITE = """
def _halves(split: str, data: str | None = None) -> dict[str, Setting]:
    links = tuple(Trace.steps([(60.0, 1e6 * (k + 1))], name=f"{split}-{k}") for k in range(3))
    return both_values(links, motions_of(split, 1))


SUITES += (Suite("halves-v1", "slow links", _halves, capacities=(2,), seeds=1),)
"""
RECIPE = """

[links.kilobytes]
about = "number kB/s, a line a second"
first = '[0-9]+ kB/s'
line = '(?P<bytes>[0-9]+) (?P<unit>kB/s)'
"""
FIGURE = '''
from dataclasses import dataclass
from typing import Any

from bufgym_papers.figures.figure import Figure
from bufgym_papers.figures.rows import FigureRows


@dataclass(frozen=True)
class Reproduction(Figure):
    """A straight line."""

    last: int = 3

    def simulate(self) -> FigureRows:
        return FigureRows({"k": k} for k in range(self.last + 1))

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        return {"grows": list(rows.column("k")) == sorted(rows.column("k"))}

    def draw(self, rows: FigureRows, figure: Any) -> None:
        figure.add_subplot().plot(rows.column("k"))
'''
SENTENCES = """
[afr-line]
title = "A line"
[afr-line.claims.grows]
place = "Sec. IV"
says = "It grows."
ours = "To {last}."
"""
COMMAND = '''"""``bufgym hello``."""


def hello(name: str) -> None:
    """Greet."""
    print(f"hello, {name}")
'''
FIELD = """
    Field("half_full", "context", "queue", "flag", "1 where half of the places are taken",
          lambda buffer, arrival: float(2 * len(buffer.slots) >= buffer.capacity)),
"""
TERM = """
@built_in("starved", unit="steps")
def starved(step: Any, memory: Any) -> float:
    "minus 1 for a step in which nothing reaches the server"
    return -float(len(step.delivered) == 0)
"""
BUS = '''
class MemoryBus:
    """Both ends in one process."""

    ENDS: Final[dict[Any, Any]] = {}

    def __init__(self, host: str, port: int, name: str, hear: Hear, peer: Peer) -> None:
        self.place, self.name, self.hear = (host, port), name, hear
        self.ENDS[self.place, name] = self
        peer(True)

    def publish(self, name: str, data: bytes) -> None:
        self.ENDS[self.place, "" if self.name else name].hear(name, data)

    def close(self) -> None:
        self.ENDS.pop((self.place, self.name), None)


BUSES: Final[dict[str, Open]] = {"memory": MemoryBus, '''
ROBOT, PAPERS = "packages/robot/bufgym_robot", "packages/papers/bufgym_papers"
ROWS = {
    "a policy": Addition(
        {},
        {
            "bufgym/policies/classic.py": ("\n\n@built_in(", f"\n{RULE}\n\n@built_in("),
            "tests/core/naive_policies.py": (
                '        "latest-only":',
                '        "newest-two": lambda: queues.KeepLast(2),\n        "latest-only":',
            ),
        },
        "assert 'newest-two' in bufgym.policies.names()\n"
        "words = '--trace lte-synthetic-0 --seconds 2 --fps 5 --seeds 1 --capacity 2 --no-bound'\n"
        "assert main(['bench', '--policies', 'newest-two', *words.split()]) == 0",
    ),
    "an observation field": Addition(
        {},
        {
            "bufgym/model/observe/on_board.py": ("ON_BOARD_FIELDS = (\n", f"ON_BOARD_FIELDS = ({FIELD}"),
            "docs/guide/yours-to-change.md": ("- `rate_trend`\n", "- `rate_trend`\n- `half_full`\n"),
        },
        "env = gym.make('bufgym/Uplink-v1', actions='slots', fields=['half_full', 'occupancy'], capacity=3)\n"
        "env.reset(seed=0)\n"
        "for _ in range(40):\n"
        "    seen = env.step(3)[0]\n"
        "    assert seen['half_full'] == (seen['occupancy'] >= 0.5)\n"
        "from bufgym.policies.learned import NAMES\n"
        "assert 'half_full' in NAMES",
    ),
    "a reward term": Addition(
        {},
        {"bufgym/model/observe/terms.py": ('\n\n@built_in("energy"', f'\n{TERM}\n\n@built_in("energy"')},
        "env = gym.make('bufgym/Uplink-v1', reward={'starved': 1.0}); env.reset(seed=0)\n"
        "assert env.step(0)[1] in (-1.0, 0.0)",
    ),
    "a scenario": Addition(
        {"bufgym/scenario/halves.py": STEADY},
        {
            "bufgym/scenario/registry.py": (
                "SCENARIOS: dict[str, tuple[Callable[[], Scenario], str]] = {\n",
                "from bufgym.scenario.halves import Halves\n"
                "SCENARIOS: dict[str, tuple[Callable[[], Scenario], str]] = {\n    'halves': (Halves, 'one in two'),\n",
            )
        },
        "assert bufgym.scenario.draw(bufgym.scenario.get('halves'), 0).arrivals['arrival_us'][1] == 1_000_000",
    ),
    "an environment": Addition(
        {},
        {
            "bufgym/__init__.py": (
                "ENVIRONMENTS = {\n",
                "ENVIRONMENTS = {\n    'bufgym/Halves-v0': ('halves', 'one in two', {'capacity': 3}),\n",
            )
        },
        "assert gym.make('bufgym/Halves-v0', actions='slots').reset(seed=0)[0]['rank'].shape == (4,)",
    ),
    "a suite": Addition(
        {},
        {"bufgym/scenario/suites/synthetic.py": ("", SUITE)},
        "from bufgym.scenario import suites\n"
        "assert [len(suites.get('halves-v1').settings(split)) for split in suites.SPLITS] == [2, 2, 2]",
    ),
    "an option of environments": Addition(
        {},
        {
            "bufgym/envs/options.py": ("    bound: bool", "    sloth: int = 0\n    bound: bool"),
            "bufgym/envs/sub_envs.py": (
                "        self._beside =",
                "        self.sloth = options.sloth\n        self._beside =",
            ),
        },
        "assert gym.make('bufgym/Uplink-v1', sloth=3).unwrapped.sub_envs.sloth == 3",
    ),
    "a trace format": Addition(
        {},
        {
            "bufgym/traces/formats/recipes.toml": ("", RECIPE),
            "tests/traces/link_files.py": ("SAMPLES = {\n", 'SAMPLES = {\n    "kilobytes": "5 kB/s\\n7 kB/s\\n",\n'),
            "docs/guide/recordings.md": ("\n| `runs` |", "\n| `kilobytes` | `5 kB/s` a second | a test |\n| `runs` |"),
        },
        "open('mine.txt', 'w').write('5 kB/s\\n7 kB/s\\n')\n"
        "assert bufgym.traces.read_trace('mine.txt').cumulative_bytes.tolist() == [0, 5000, 12000]",
    ),
    "a figure of a paper": Addition(
        {f"{PAPERS}/figures/afr_line.py": FIGURE},
        {f"{PAPERS}/figures/afr.toml": ("", SENTENCES)},
        "assert main(['reproduce', 'afr-line', '--out', 'figures']) == 0",
    ),
    "a command": Addition(
        {"bufgym/cli/hello.py": COMMAND},
        {"bufgym/cli/__init__.py": ('    "play":', '    "hello": "bufgym.cli.hello:hello",\n    "play":')},
        "assert main(['hello', 'you']) == 0",
    ),
    "a transport": Addition(
        {},
        {
            f"{ROBOT}/buses.py": ("BUSES: Final[dict[str, Open]] = {", BUS.lstrip("\n")),
            f"{ROBOT}/commands.py": ('Literal["tcp", ', 'Literal["memory", "tcp", '),
        },
        "from bufgym_robot import TRANSPORTS, PolicyQueue, Receiver, Sender\n"
        "async def all_come():\n"
        "    came = []\n"
        "    receiver = Receiver(came.append)\n"
        "    queue = PolicyQueue('drop-oldest', 4)\n"
        "    sender = Sender(queue, lambda: TRANSPORTS['memory']('127.0.0.1', 1), 'acked')\n"
        "    await receiver.listen(1, '127.0.0.1', 'memory')\n"
        "    queue.put(b'body', 4)\n"
        "    queue.close()\n"
        "    await asyncio.wait_for(sender.run(), 10)\n"
        "    await receiver.close()\n"
        "    assert [message.body for message in came] == [b'body']\n"
        "asyncio.run(all_come())",
    ),
}


def copied(folder: Path, rows: Iterable[str], forgotten: Collection[str] = ()) -> Path:
    """Copy the sources into a folder and add what these rows add, but for the lines of the forgotten files."""
    for name in ("bufgym", "packages", "agents", "traces", "tests", "docs", "website", "examples", "studies"):
        shutil.copytree(REPO / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in (path for path in REPO.iterdir() if path.suffix in (".md", ".py", ".toml", ".yml")):
        shutil.copy(path, folder)
    for row in rows:
        addition = ROWS[row]
        for name, text in addition.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        for name, (old, new) in addition.lines.items():
            text = (folder / name).read_text(encoding="utf-8")
            assert not old or old in text, (row, name)
            if name not in forgotten:
                (folder / name).write_text(text.replace(old, new, 1) if old else text + new, encoding="utf-8")
    return folder


def surroundings(folder: Path) -> dict[str, str]:
    """The environment of a process that imports the copy in a folder, as plain Python."""
    places = os.pathsep.join(str(folder / name) for name in (".", "packages/robot", "packages/papers"))
    return {**os.environ, "PYTHONPATH": places, "BUFGYM_KERNELS": "python", "MPLBACKEND": "agg"}

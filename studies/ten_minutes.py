"""The score after ten minutes of one core, for each library: the table of results/trainers.md.

python -m studies.ten_minutes --lines studies/ten_minutes.csv
python -m studies.ten_minutes --lines studies/ten_minutes.csv --page results/trainers.md

The first command trains all libraries of ``studies.libraries``, one process after another: first each with one seed and
``regret``, then with ``paired``, then the next seed. Each evaluation is a line of the file at once. The same command
goes on where it was cut: what is complete in the file stays, and a training that was cut or failed is made anew. A
library that this Python does not have gets an environment of its own below ``--environments``, with what its row of
docs/guide/trainers.md installs; where that fails, the line says why. The second command puts the table of the file into
the page.
"""

from __future__ import annotations

import csv
import importlib.util
import io
import math
import os
import re
import shlex
import subprocess
import sys
import venv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from filelock import FileLock, Timeout

from bufgym.benchmark.bootstrap import RESAMPLES, SEED, interval, stream, times_drawn
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.files import write_text
from studies.budget import LINE, MINUTES
from studies.libraries import HELD, LIBRARIES, Library
from studies.page import command, table, written
from studies.sb3_defaults import RULES, Episodes, append

REPO = Path(__file__).resolve().parent.parent
TRAINERS = REPO / "docs" / "guide" / "trainers.md"
BEGIN, END = "<!-- begin: studies.ten_minutes -->", "<!-- end: studies.ten_minutes -->"


class Training(NamedTuple):
    """One training; its fields are columns of the file of lines."""

    library: str
    reward: str
    seed: int


Line = dict[str, str]


def read(lines: Path) -> dict[Training, list[Line]]:
    """The lines of each training, in the order of the file."""
    found: dict[Training, list[Line]] = {}
    if lines.exists():
        with lines.open(newline="", encoding="utf-8") as file:
            for line in csv.DictReader(file):
                found.setdefault(Training(line["library"], line["reward"], int(line["seed"])), []).append(line)
    return found


def forget(lines: Path, training: Training) -> None:
    """Take the lines of this training out of the file."""
    kept = (line.values() for one, of_it in read(lines).items() for line in of_it if one != training)
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([LINE, *kept])
    write_text(lines, text.getvalue())


def is_complete(of_it: Iterable[Line], minutes: float) -> bool:
    """Whether a training has its last evaluation."""
    return any(line["score"] and float(line["minutes"]) == minutes for line in of_it)


def words(package: str) -> list[str]:
    """What the package's row of docs/guide/trainers.md installs besides bufgym."""
    [row] = re.findall(rf"^\| \[[^|]*\| `{package}` \| `([^`]*)` \|", TRAINERS.read_text("utf-8"), re.MULTILINE)
    return [word for word in shlex.split(row) if not word.startswith(".")]


def python_of(library: Library, environments: Path) -> str:
    """A Python that has the library: this one, or one in an environment of its own, made if it is not there."""
    if importlib.util.find_spec(library.package):
        return sys.executable
    folder = environments / f"venv-{library.package}"
    python, ready = str(folder / "bin" / "python"), folder / "ready"
    if not ready.exists():
        print(f"{library.package}: making {folder}", flush=True)
        venv.create(folder, clear=True, with_pip=True)
        install = [
            python,
            "-m",
            "pip",
            "install",
            "--quiet",
            "--no-compile",
            ".[train,plot]",
            "psutil",
            *words(library.package),
        ]
        # Kernels come from the checkout and its cache.
        where = os.environ | {"BUFGYM_NO_KERNELS": "1"}
        done = subprocess.run(install, cwd=REPO, env=where, capture_output=True, text=True, check=False)
        if done.returncode:
            raise BufgymError(f"does not install: {last_line(done.stderr, 'ERROR')}")
        ready.touch()
    return python


def last_line(text: str, word: str = "") -> str:
    """The last line with the word, or the last at all."""
    found = text.strip().splitlines() or ["no message"]
    return ([line for line in found if word in line] or found)[-1].strip()


def train(training: Training, minutes: Sequence[float], lines: Path, environments: Path, episodes: int) -> None:
    """Train once in a process of its own; where that fails, append a line that says why."""
    try:
        python = python_of(LIBRARIES[training.library], environments)
        options = [f"--{name}={value}" for name, value in training._asdict().items()]
        options += [f"--lines={lines.absolute()}", f"--episodes={episodes}", "--minutes", *map(str, minutes)]
        paths = os.pathsep.join([str(REPO), *map(str, sorted((REPO / "packages").iterdir()))])
        where = os.environ | {"PYTHONPATH": paths}
        begun = [python, "-m", "studies.budget", *options]
        done = subprocess.run(begun, cwd=REPO, env=where, stderr=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            print(done.stderr[-3_000:], flush=True)
            raise BufgymError(f"fails: {last_line(done.stderr)}")
    except BufgymError as error:
        print(f"{training.library}: {error}", flush=True)
        append(lines, LINE, (training.library, "", training.reward, training.seed, "", "", "", error))


def rows(lines: Path, minutes: Sequence[float]) -> list[list[str]]:
    """A row for each library and reward: the mean score over seeds after each of the minutes, best first.

    The last has its interval over seeds where there are several. A library without a score has the reason.
    """
    seeds: dict[tuple[str, str], list[list[Line]]] = {}
    for training, of_it in read(lines).items():
        seeds.setdefault(training[:2], []).append(of_it)
    made = []
    for (name, reward), of_seeds in seeds.items():
        after = {m: [float(line["score"]) for of_it in of_seeds for line in of_it if due(line, m)] for m in minutes}
        why = [line["why"] for of_it in of_seeds for line in of_it if line["why"]]
        last = after[minutes[-1]]
        held = f", held for {HELD[reward]}" if reward in HELD else ""
        label = [LIBRARIES[name].title, reward + held]
        if not any(after.values()):
            made.append((-math.inf, [*label, "0", *[""] * (len(minutes) - 1), why[-1]]))
            continue
        cells = [f"{np.mean(scores):.2f}" if scores else "" for scores in after.values()]
        if len(last) > 1:
            drawn = times_drawn(len(last), RESAMPLES, stream(SEED, name + reward)) @ np.array(last) / len(last)
            cells[-1] = written(interval(drawn, len(last), within=(-math.inf, 1)), ".2f")
        made.append((float(np.mean(last)) if last else -math.inf, [*label, str(max(map(len, after.values()))), *cells]))
    return [row for _, row in sorted(made, key=lambda pair: -pair[0])]


def due(line: Line, minutes: float) -> bool:
    """Whether the line has the score after so many minutes."""
    return bool(line["score"]) and float(line["minutes"]) == minutes


def as_table(lines: Path, minutes: Sequence[float], rules: Mapping[str, float]) -> list[str]:
    """The table: libraries, and below them what needs no training."""
    head = ("trainer", "reward", "seeds", *(f"{m:g} min" for m in minutes))
    untaught = [
        [name, "no training", "", *[""] * (len(minutes) - 1), f"{rules[name]:.2f}"]
        for name in sorted(rules, key=lambda name: -rules[name])
    ]
    return table(head, [*rows(lines, minutes), *untaught])


def renew(page: Path, made: Sequence[str]) -> None:
    """Put the table between the page's two marks."""
    text = page.read_text("utf-8")
    if not 0 <= text.find(BEGIN) < text.find(END):
        raise BufgymError(f"{page}: has no {BEGIN} with {END} below it")
    before, after = text[: text.index(BEGIN)], text[text.index(END) :]
    write_text(page, "\n".join([before + BEGIN, "", *made, "", after]))


def fill(todo: Iterable[Training], minutes: Sequence[float], lines: Path, environments: Path, episodes: int) -> None:
    """Train what is not complete in the file."""
    lines.parent.mkdir(parents=True, exist_ok=True)
    for training in todo:
        done = read(lines).get(training, [])
        if not is_complete(done, minutes[-1]):
            if done:
                forget(lines, training)
            train(training, minutes, lines, environments, episodes)


def page(
    libraries: Sequence[str] = tuple(LIBRARIES),
    rewards: Sequence[str] = ("regret", "paired"),
    seeds: Sequence[int] = (0,),
    minutes: Sequence[float] = MINUTES,
    lines: Path = Path("runs/ten_minutes.csv"),
    environments: Path = Path("runs/environments"),
    episodes: int = 40,
    page: Path | None = None,
) -> None:
    """Train, or with ``page`` put the table into it."""
    for name in libraries:
        if name not in LIBRARIES:
            raise unknown("library", name, LIBRARIES)
    if page is not None:
        fixed = Episodes(episodes)
        renew(page, as_table(lines, minutes, {name: fixed.of_rule(rule) for name, rule in RULES.items()}))
        return
    todo = [Training(name, reward, seed) for seed in seeds for reward in rewards for name in libraries]
    try:
        with FileLock(f"{lines}.lock", timeout=0):
            fill(todo, minutes, lines, environments, episodes)
    except Timeout:
        raise BufgymError(f"{lines}: another process fills it") from None


if __name__ == "__main__":
    command(page)

"""``train.py tune``: the named numbers of a rule, searched by CMA-ES over whole episodes.

A candidate is the rule with other numbers, each its default times e^z for the searched z. A number that is 0 stays. All
candidates of a generation meet the same episodes, so only their decisions tell them apart. The next generation meets
others, and validation episodes say which mean to keep. The optimiser is pycma (Hansen, The CMA Evolution Strategy: A
Tutorial, arXiv 1604.00772).
"""

from __future__ import annotations

import json
import pickle
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cma
import numpy as np
from numpy.typing import NDArray

from agents.runs import Record, Validations, prepare, seed_bar, write_notes
from agents.settings import Tune
from agents.tuning_episodes import Episodes, Task
from bufgym.benchmark.compare import compare
from bufgym.cli.options import load_policies
from bufgym.policies import Policy, get
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.files import locked, replaced, write_text

POPULATION, SIGMA = 16, 0.2
"""Candidates of a generation, and the first step: a fifth of each number."""
MEMORY = 5
"""Generations over which the search's mean is averaged, exponentially: the noise of single parts cancels."""
DIGITS = 3
"""Significant digits of a number."""


@dataclass
class Search:
    """The state of a search, as in its checkpoint."""

    rule: Policy = field(repr=False)
    names: tuple[str, ...]
    strategy: Any
    average: NDArray[np.float64]
    steps: int = 0
    generations: int = 0
    seconds: float = 0.0

    @staticmethod
    def around(rule: Policy, names: Sequence[str], seed: int) -> Search:
        """A new search around the rule's numbers."""
        options = {"seed": seed + 1, "popsize": POPULATION, "verbose": -9}
        begin = np.zeros(len(names))
        return Search(rule, tuple(names), cma.CMAEvolutionStrategy(begin, SIGMA, options), begin)

    def policy(self, z: NDArray[np.float64]) -> Policy:
        """The rule with its numbers times e^z; itself for z = 0."""
        if not z.any():
            return self.rule
        plain = get(self.rule.name.partition(":")[0])  # a name holds each setting once
        numbers = {n: v for n, v in self.rule.parameters.items() if v != plain.parameters[n]}
        found = (self.rule.parameters[n] * np.exp(k) for n, k in zip(self.names, z, strict=True))
        numbers |= {n: float(f"{v:.{DIGITS}g}") for n, v in zip(self.names, found, strict=True)}
        return plain.with_parameters(**numbers)

    def generation(self, part: Sequence[Episodes]) -> float:
        """Ask for candidates, measure them and report, once; return the best measure."""
        asked = self.strategy.ask()
        measures = [mean(self.policy(z), part) for z in asked]
        self.strategy.tell(asked, measures)
        self.average = self.average + (self.strategy.mean - self.average) / MEMORY
        self.steps += POPULATION * sum(episodes.decisions for episodes in part)
        self.generations += 1
        return min(measures)

    def saved(self) -> bytes:
        """All but the rule, whose functions a file does not hold."""
        return pickle.dumps({name: value for name, value in vars(self).items() if name != "rule"})

    @staticmethod
    def read(saved: bytes, rule: Policy) -> Search:
        """What ``saved`` wrote; only from your own run: pickles run code when they are read."""
        return Search(rule, **pickle.loads(saved))


def mean(policy: Policy, episodes: Sequence[Episodes]) -> float:
    """The mean measure, the less the better."""
    return float(np.mean([part.measure(policy) for part in episodes]))


def searched(rule: Policy, asked: Sequence[str]) -> list[str]:
    """The numbers to search, by name."""
    for name in asked:
        if name not in rule.parameters:
            raise unknown("parameter", name, rule.parameters, place=f"policy {rule.name}")
    names = [name for name in (asked or rule.parameters) if rule.parameters[name] > 0]
    if not names:
        has = "no numbers" if not rule.parameters else "no number above 0 among those asked for"
        raise BufgymError(f"policy {rule.name}: has {has}: tune searches a rule's named parameters")
    return names


def tune(settings: Tune) -> Policy:
    """Search, keep what is best on validation, compare it with the plain rule on other episodes; return it."""
    load_policies(settings.policy_file)
    rule = get(settings.rule)
    names, task = searched(rule, settings.parameters), Task.of(settings.place, rule)
    if (task.kind == "topics") != rule.for_topics:
        of = "a scheduler of several topics" if rule.for_topics else "a drop rule of one queue"
        has = "several topics" if task.kind == "topics" else "one queue"
        raise BufgymError(f"policy {rule.name}: is {of}, and {settings.place.on or settings.place.workload} has {has}")
    folder = prepare(settings)
    try:
        with locked(folder):
            found = _search(settings, task, Search.around(rule, names, settings.seed), folder)
            _report(settings, task, rule, found, folder)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(folder.name) from None
    return found


def _search(settings: Tune, task: Task, state: Search, folder: Path) -> Policy:
    checkpoint, rule = folder / "search.pkl", state.rule
    if checkpoint.exists():
        state = Search.read(checkpoint.read_bytes(), rule)
    training, judges = task.training(settings.seed), task.validation()
    curve = Record(folder / "curve.csv", ("steps", "seconds", "measure"), state.steps)
    validations = Validations(folder, ("measure",), min, settings, state.steps)
    began = time.perf_counter() - state.seconds
    bar = seed_bar(settings.steps, state.steps, settings.seed, 0)
    kept = folder / "policy.txt"
    while True:
        ended = state.steps >= settings.steps
        if validations.due(state.steps, last=ended):
            policy = state.policy(state.average)
            measure = mean(policy, judges)
            if validations.add(state.steps, state.seconds, (measure,)):
                write_text(kept, policy.name + "\n")
            bar.set_postfix_str(f"{measure:.4f} on validation", refresh=False)
            if not sys.stderr.isatty():
                print(f"{state.steps:,} of {settings.steps:,} steps, {measure:.4f} on validation", flush=True)
        if ended:
            break
        best = state.generation(training[state.generations % len(training)])
        state.seconds = round(time.perf_counter() - began, 3)
        curve.append(state.steps, state.seconds, best)
        with replaced(checkpoint) as unfinished:
            unfinished.write_bytes(state.saved())
        bar.update(state.steps - bar.n)
    bar.close()
    return get(kept.read_text(encoding="utf-8").strip())


def _report(settings: Tune, task: Task, rule: Policy, found: Policy, folder: Path) -> None:
    """The tuned rule beside the plain one: on a suite's test split, on a scenario's own episodes from number 0 on."""
    write_notes(folder, settings, [settings.seed])
    write_text(folder / "results.json", json.dumps({"policy": found.name, "command": settings.command}) + "\n")
    if found.name == rule.name:
        print(f"{rule.name} as it is was best on validation; policy.txt in {folder} holds its name")
        return
    once: dict[str, Any] = {"seeds": 1} if task.is_once else {}
    of_suite: dict[str, Any] = {"data": settings.place.data, "policy_file": settings.policy_file}
    suite = of_suite if isinstance(task.on, str) else once
    shown = found if isinstance(task.on, str) else replace(found, name="tuned")  # processes of a suite know it by name
    done = compare([shown, rule], task.on, capacity=task.capacities, against=rule, **suite)
    write_text(folder / "results.txt", f"{done}\n")
    print(done)
    if task.is_once:
        print("\none recording on one link: tuned, validated and compared on the same episode")
    print(f"\n{found.name}\n\nbufgym bench, robots and bufgym export take this name; policy.txt in {folder} holds it")

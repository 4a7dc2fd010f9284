"""The package's kernels as C: which ones it has, found by playing a little of everything.

``hatch_build.py`` compiles them into the library that comes with the package. What is not among them is compiled at its
first use: nothing but the time of that depends on what is played here.
"""

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from bufgym import policies, scenario
from bufgym.benchmark.run import run
from bufgym.envs import FleetVecEnv, SenderVectorEnv, own
from bufgym.envs.expert import Player, online
from bufgym.envs.expert.hindsight import Clairvoyant
from bufgym.jit import Hook, code, named
from bufgym.jit.values import NotNumbersError
from bufgym.kernels.program import Program
from bufgym.model import observe
from bufgym.policies import ACCEPT, Policy
from bufgym.scenario import FleetScenario, Interruption
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders
from bufgym.sim.rollout import python_arrival, python_view

_L = 3
_SHORT: dict[str, dict[str, Any]] = {
    "interruption": {"t_max": 5},
    "lte": {"duration_s": 0.3},
    "topics": {"duration_s": 0.5},
}
_FIELDS = ["rank", "loss", "occupancy", "rate_long"]
"""Some of each table."""
_FILES = 12
"""Files of C: enough for the processors to share."""


def _step(batch: Any, rows: int) -> None:
    batch.reset(seed=0)
    for _ in range(3):
        batch.step(np.zeros(rows, np.int64))


def _environments() -> None:
    slots: dict[str, Any] = {"actions": "slots"}
    ordered: tuple[dict[str, Any], ...] = ({}, {"bound": True}, {"reward": "cost"}, {"reward": "paired"})
    for name, short in _SHORT.items():
        for options in (*ordered, slots, {**slots, "fields": _FIELDS}):
            if name == "topics" and options in ordered:
                continue
            batch = SenderVectorEnv(2, name, _L, **short, **options)
            _step(batch, 2)
            Player(policies.get("drop-oldest"), 2).actions(batch.sub_envs.senders)
            if name != "topics":
                Clairvoyant(batch).actions()
    online(SenderVectorEnv(1, "interruption", 2, t_max=3, law="geometric", t_mean=2.0))
    for options in ({}, {"fields": _FIELDS}):
        _step(FleetVecEnv(1, 2, "lte", _L, duration_s=0.3, **options), 2)


def _run(names: Iterable[str], *scenarios: Any) -> None:
    for on in scenarios:
        run([policies.get(name) for name in names], on, [_L], 1)


def _policies() -> None:
    for names in (policies.names(), policies.names(named_only=True)):
        for policy in map(policies.get, names):
            if policy.compile:
                _ = policy.compiled
    one = ["afr", "clairvoyant"]
    _run(one, Interruption(t_max=5), scenario.get("lte", duration_s=0.5))
    _run(one, scenario.get("lte", duration_s=0.5, size_cv=0.5))
    _run(["fifo"], scenario.get("topics", duration_s=0.5))
    _run(["afr"], FleetScenario.of(2, "lte", duration_s=0.5))


def _zero(*_: Any) -> float:
    return 0.0


def _in_python() -> None:
    """What plain Python calls one by one: policies, fields and terms of one's own."""
    for on in (scenario.get("lte", duration_s=0.3), scenario.get("topics", duration_s=0.5)):
        several, n = bool(on.topics), 4
        policy = Policy("python", lambda buffer, arrival, memory: ACCEPT)
        senders = Senders(1, n, on.value, max_messages=on.max_messages, topics=on.topics)
        senders.load_all([(0, draw(on, 0), None)])
        pointers, flat = own.pointers(), np.zeros((1, 9), np.float32)
        for kind in ("slot", "context"):
            own.WRITERS[kind](senders.batch, Hook(_zero, pointers[kind]), 0, flat)
        marks, ended, reals = np.zeros((1, 4), np.int64), np.zeros(1, np.bool_), np.zeros((1, 1))
        hook = Hook(_zero, pointers["term"])
        own.WRITERS["term"](senders.batch, hook, marks, ended, reals, reals[0], 0, reals)
        buffer = python_view(named(senders.batch), 0)
        arrival = python_arrival(named(senders.batch), 0)
        slots, context = np.zeros((99, n + 1), np.float32), np.zeros(99, np.float32)
        if several:
            observe.observe_topic_slots(buffer, arrival, True, slots)
            observe.observe_topic_context(buffer, arrival, True, context)
        else:
            observe.observe(buffer, arrival, slots, context)
            observe.write_chosen(buffer, arrival, observe.chosen_at({"rank": 0}), flat[0])
            observe.find_candidates(buffer, arrival, np.zeros(n + 1, np.int64), np.zeros(n + 1))
        senders.run(policy)


def entries() -> list[tuple[Any, Any]]:
    """Every kernel that Python calls, or hands over, with its kinds; in plain Python no C is needed for that."""
    code.noted = []
    try:
        _environments()
        _policies()
        _in_python()
        return [(f, kinds) for f, kinds in code.noted if code.is_own(f) and f.__module__ != __name__]
    finally:
        code.noted = None


def sources(folder: Path) -> list[Path]:
    """Write the kernels' C into ``folder``, and ``entries.json``, which says what each was made from."""
    programs, states = [Program() for _ in range(_FILES)], dict[str, str]()
    for number, (function, kinds) in enumerate(entries()):
        symbol = code.symbol_of(function, kinds)
        if symbol in states:
            continue
        try:
            code.add(programs[number % _FILES], function, kinds, symbol)
        except NotNumbersError:
            continue
        states[symbol] = code.state_of(function, kinds)
    files = []
    for number, program in enumerate(programs):
        files.append(folder / f"kernels_{number}.c")
        files[-1].write_text(program.source(), encoding="utf-8")
    listed = {"sources": code.sources(), "translator": code.translator(), "python": sys.implementation.cache_tag}
    (folder / "entries.json").write_text(json.dumps({**listed, "states": states}), encoding="utf-8")
    return files

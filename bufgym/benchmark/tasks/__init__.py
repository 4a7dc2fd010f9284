"""Kinds of experiment behind the protocol ``Task``: one queue, one queue under stress, topics, fleets.

A new kind of task adds a file here and an entry of ``TASKS``.
"""

from dataclasses import replace
from typing import Any

from bufgym.benchmark.tasks.fleet import FleetTask
from bufgym.benchmark.tasks.queue import QueueTask
from bufgym.benchmark.tasks.stress import StressTask
from bufgym.benchmark.tasks.task import Task
from bufgym.benchmark.tasks.topics import TopicsTask
from bufgym.scenario import suites
from bufgym.utils.errors import BufgymError

__all__ = ["TASKS", "FleetTask", "QueueTask", "StressTask", "Task", "TopicsTask", "task_for", "task_of"]

TASKS: dict[str, Task] = {task.kind: task for task in (QueueTask(), StressTask(), TopicsTask(), FleetTask())}
"""``Suite.kind`` -> task."""


def task_of(suite: str) -> Task:
    """The task of a suite's scenarios."""
    return TASKS[suites.get(suite).kind]


def task_for(scenario: Any, **settings: Any) -> Task:
    """Find the task for a scenario; a scenario of unknown kind is for one queue.

    ``settings`` are the task's own, such as max_bytes, decide_at and bound of ``QueueTask``.
    """
    task = next((task for task in TASKS.values() if isinstance(scenario, task.scenarios)), TASKS["queue"])
    for name in settings:
        if not hasattr(task, name):
            raise BufgymError(f"{name} = {settings[name]!r}: is for one queue, not for {task.kind}")
    return replace(task, **settings)

"""Asyncio tasks that belong to one end of a connection and end with it."""

import asyncio
from collections.abc import Coroutine, Iterable
from typing import Any, Final

AGAIN_S: Final = 5.0  # Time after which a task that has been cancelled and goes on is cancelled again


class Tasks:
    """Tasks still running."""

    def __init__(self) -> None:
        self._running: set[asyncio.Task[None]] = set()

    def begin(self, work: Coroutine[Any, Any, None], name: str = "") -> asyncio.Task[None]:
        """Start ``work`` as a task and hold it, because the loop forgets a task without references."""
        task = asyncio.create_task(work, name=name)
        self._running.add(task)
        task.add_done_callback(self._running.discard)
        return task

    def cancel(self, name: str) -> None:
        """Cancel the tasks of this name."""
        for task in self._running:
            if task.get_name() == name:
                task.cancel()

    async def end(self) -> None:
        """Cancel all tasks and wait for their end."""
        await _ended(self._running)


async def until_one_ends(*works: Coroutine[Any, Any, Any]) -> None:
    """Run all until one ends, cancel the others and wait for them, then raise the first one's error."""
    tasks = [asyncio.create_task(work) for work in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        await _ended(tasks)


async def _ended(tasks: Iterable[asyncio.Task[Any]]) -> None:
    """Cancel tasks until all have ended; ``asyncio.wait_for`` of Python 3.11, in libraries, may lose a cancellation."""
    waiting = set(tasks)
    while waiting:
        for task in waiting:
            task.cancel()
        done, waiting = await asyncio.wait(waiting, timeout=AGAIN_S)
        for task in done:
            _ = task.cancelled() or task.exception()  # which asyncio would report as never retrieved

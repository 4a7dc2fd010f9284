"""Asyncio tasks that belong to one end of a connection and end with it."""

import asyncio
from collections.abc import Coroutine
from typing import Any


class Tasks:
    """Tasks still running."""

    def __init__(self) -> None:
        self._running: set[asyncio.Task[None]] = set()

    def begin(self, work: Coroutine[Any, Any, None], name: str = "") -> None:
        """Start ``work`` as a task and hold it, because the loop forgets a task without references."""
        task = asyncio.create_task(work, name=name)
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    def cancel(self, name: str) -> None:
        """Cancel the tasks of this name."""
        for task in self._running:
            if task.get_name() == name:
                task.cancel()

    async def end(self) -> None:
        """Cancel all tasks and wait for their end."""
        for task in self._running:
            task.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)


async def until_one_ends(*works: Coroutine[Any, Any, Any]) -> None:
    """Run all until one ends, cancel the others and wait for them, then raise the first one's error."""
    tasks = [asyncio.create_task(work) for work in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

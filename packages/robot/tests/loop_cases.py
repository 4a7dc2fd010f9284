"""What the tests of sockets share. pytest-asyncio runs coroutines, in one loop for each module."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import pytest
from needs import needs

from bufgym.jit import JIT

compiled = pytest.mark.skipif(not JIT, reason=needs("compiled", "uncompiled, decisions take as long as messages do"))


@contextlib.asynccontextmanager
async def beside(*works: Coroutine[Any, Any, Any]) -> AsyncIterator[list[asyncio.Task[Any]]]:
    """Run these as tasks beside the block, which fails with them; they are cancelled when it ends."""
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(work) for work in works]
        yield tasks
        for task in tasks:
            task.cancel()


async def until(holds: Callable[[], Any]) -> None:
    """Return once ``holds()``, within a minute."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.002)

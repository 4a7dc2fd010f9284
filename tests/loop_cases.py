"""Tests that are coroutines: a module has one event loop, and what a test begins in it ends with the test."""

import asyncio
import contextlib
import inspect
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from typing import Any

import pytest

from bufgym.ground.kernel import JIT

PATIENCE_S = 600
"""Ends a test that hangs. No test waits for it."""
compiled = pytest.mark.skipif(not JIT, reason="uncompiled, decisions take as long as messages do")


@pytest.fixture(scope="module", autouse=True)
def runner() -> Iterator[asyncio.Runner]:
    with asyncio.Runner() as one:
        yield one


def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    given = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}

    async def test() -> None:
        async with asyncio.timeout(PATIENCE_S):
            await pyfuncitem.obj(**given)

    pyfuncitem.funcargs["runner"].run(test())
    return True


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

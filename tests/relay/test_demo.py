"""The demonstration does not wait for the compiler: its page is there at once, and its robots uncompiled."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import AsyncIterator
from typing import Any

import pytest
from relay_cases import client, run

from bufgym.cli import main
from bufgym.errors import BufgymError
from bufgym.policies import registry
from bufgym.policies.registry import Policy
from bufgym.relay import demo, policies
from bufgym.relay.session import Session


def test_the_page_does_not_wait_for_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    compiler, compiled, said = threading.Event(), policies.compiled, list[str]()

    def slowly(chosen: Policy) -> Policy:
        if chosen.name == "drop-oldest":  # the robots'
            compiler.wait(20)
        return compiled(chosen)

    monkeypatch.setattr(policies, "compiled", slowly)
    monkeypatch.setattr(demo, "PATIENCE_S", 0.05)

    async def story() -> None:
        async with demo.running(1, policy="drop-oldest", fades=False, say=said.append) as port:

            def page() -> bytes:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10) as answer:
                    return bytes(answer.read())

            assert b"<html" in (await asyncio.to_thread(page)).lower()
            async with client(port) as viewer:
                await viewer.subscribe("^/robots/")
                assert await viewer.nothing(0.5)
                assert said == ["the robots come when their queue is compiled: up to a minute, the first time"]
                compiler.set()
                assert (await viewer.next()).topic.startswith("/robots/robot-1/")

    run(story)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def test_uncompiled_robots_are_seen_until_the_compiled_take_over() -> None:
    port = free_port()

    async def story() -> None:
        topics: asyncio.Queue[str] = asyncio.Queue()
        viewer = Session(f"ws://127.0.0.1:{port}", "viewer")
        viewer.subscribe("^/robots/", lambda message: topics.put_nowait(message.topic))
        async with (
            demo.uncompiled(["--robots", "1", "--port", str(port), "--no-browser"]),
            asyncio.TaskGroup() as tasks,
        ):
            running = tasks.create_task(viewer.run())
            assert (await topics.get()).startswith("/robots/robot-1/")
            running.cancel()
        socket.create_server(("127.0.0.1", port)).close()  # the place is free

    run(story)


UNTIL_KILLED = """
import asyncio, sys
from bufgym.relay import demo

async def show():
    async with demo.uncompiled(["--robots", "1", "--port", sys.argv[1], "--no-browser"]):
        await asyncio.sleep(60)

asyncio.run(show())
"""


def test_who_is_told_to_end_leaves_no_robots_behind() -> None:
    port = free_port()

    def there() -> bool:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=5).close()
        except OSError:
            return False
        return True

    def wait_until(wanted: bool) -> None:
        until_s = time.monotonic() + 30
        while there() != wanted:
            assert time.monotonic() < until_s
            time.sleep(0.1)

    with subprocess.Popen([sys.executable, "-c", UNTIL_KILLED, str(port)]) as process:
        wait_until(True)
        process.terminate()
        assert process.wait(30) == -signal.SIGTERM
    wait_until(False)


def test_the_command_shows_them_while_another_process_compiles(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done: list[Any] = []

    @contextlib.asynccontextmanager
    async def uncompiled(words: list[str]) -> AsyncIterator[None]:
        done.append(words)
        yield
        done.append("ended")

    def running(*_: Any, **__: Any) -> Any:
        done.append("begun")
        raise BufgymError("enough")

    monkeypatch.setattr(policies, "kept", lambda chosen: False)
    monkeypatch.setattr(policies, "compiled", lambda chosen: done.append(f"compiled {chosen.name}"))
    monkeypatch.setattr(demo, "uncompiled", uncompiled)
    monkeypatch.setattr(demo, "running", running)
    words = ["--robots", "2", "--port", "7999", "--policies", "afr", "--no-browser"]
    assert main(["relay", "demo", *words]) == 2
    assert capsys.readouterr().err == "compiled: the robots begin anew\nbufgym: error: enough\n"
    assert done == [words, "compiled afr", "ended", "begun"]


def test_what_is_not_kept_another_process_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, code = list[Any](), 0

    def called(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        asked.append(command)
        return subprocess.CompletedProcess(command, code)

    monkeypatch.setattr(policies, "kept", lambda chosen: False)
    monkeypatch.setattr(subprocess, "run", called)
    assert policies.compiled(registry.get("afr")).name == "afr"
    code = -2  # Ctrl-C
    with pytest.raises(BufgymError, match="policy afr: stopped while it was compiled"):
        policies.compiled(registry.get("afr"))
    assert asked == 2 * [[sys.executable, "-m", "bufgym.relay.policies", "afr"]]


@pytest.mark.parametrize("name", ["drop-oldest", "my-own"])
def test_that_process_knows_what_comes_with_bufgym(name: str) -> None:
    done = subprocess.run([sys.executable, "-m", "bufgym.relay.policies", name], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")

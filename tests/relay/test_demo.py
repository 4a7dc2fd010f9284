"""The demonstration does not wait for the compiler: its page is there at once, and its robots uncompiled."""

import asyncio
import contextlib
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from cli_cases import fails
from loop_cases import beside, until
from relay_cases import client, nothing

from bufgym.cli import main
from bufgym.ground.errors import BufgymError
from bufgym.policies import registry
from bufgym.policies.registry import Policy
from bufgym.relay import demo, policies
from bufgym.relay.session import Session
from bufgym.robot.sockets import free_port


async def test_the_page_does_not_wait_for_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    compiler, compiled, said = threading.Event(), policies.compiled, list[str]()

    def slowly(chosen: Policy) -> Policy:
        if chosen.name == "drop-oldest":  # the robots'
            compiler.wait()
        return compiled(chosen)

    monkeypatch.setattr(policies, "compiled", slowly)
    monkeypatch.setattr(demo, "PATIENCE_S", 0.01)
    async with demo.running(1, policy="drop-oldest", fades=False, say=said.append) as port, client(port) as viewer:
        try:

            def page() -> bytes:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
                    return bytes(answer.read())

            assert b"<html" in (await asyncio.to_thread(page)).lower()
            await viewer.subscribe("^/robots/")
            await until(lambda: said)
            assert said == ["the robots come when their queue is compiled: up to a minute, the first time"]
            assert await nothing(viewer)
        finally:
            compiler.set()
        assert (await viewer.next()).topic.startswith("/robots/robot-1/")


async def test_the_uncompiled_robots_are_a_process_as_long_as_the_block(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A shell script stands in for Python: it says what it was given and waits to be ended."""
    python, told = tmp_path / "python", tmp_path / "told"
    python.write_text(f'#!/bin/sh\ntrap "echo ended >> {told}; exit" TERM\necho $NUMBA_DISABLE_JIT $* > {told}.new\n')
    python.write_text(f"{python.read_text()}mv {told}.new {told}\nwhile :; do sleep 0.01; done\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    async with demo.uncompiled(["--robots", "1"]):
        await until(told.exists)
    assert told.read_text() == "1 -m bufgym relay demo --robots 1\nended\n"


UNTIL_KILLED = """
import asyncio, sys
from bufgym.relay import demo

async def show():
    async with demo.uncompiled(["--robots", "1", "--port", sys.argv[1], "--no-browser"]):
        await asyncio.Event().wait()

asyncio.run(show())
"""


@pytest.mark.nightly
async def test_who_is_told_to_end_leaves_no_robots_behind() -> None:
    """Robots are seen until the program that shows them is told to end; then their place is free."""
    port, topics = free_port("127.0.0.1"), asyncio.Queue[str]()
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", UNTIL_KILLED, str(port))
    viewer = Session(f"ws://127.0.0.1:{port}", "viewer")
    viewer.subscribe("^/robots/", lambda message: topics.put_nowait(message.topic))
    async with beside(viewer.run()):
        assert (await topics.get()).startswith("/robots/robot-1/")
        process.terminate()
        assert await process.wait() == -signal.SIGTERM

    def free() -> bool:
        with contextlib.suppress(OSError):
            socket.create_server(("127.0.0.1", port)).close()
            return True
        return False

    await until(free)


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


def test_the_commands_name_what_is_wrong(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    missing = str(tmp_path / "none")
    for words, naming in (
        (["robot", "--config", missing], missing),
        (["robot", "--bag", missing], missing),
        (["robot", "--ros", "2"], "--ros needs --config"),
        (["robot", "--to", "there:1"], "there:1: must be ws://HOST:PORT"),
        (["robot", "--token-file", missing], missing),
        (["robot", "--policies", "oracle"], "oracle"),
        (["demo", "--robots", "0"], "must be a whole number >= 1"),
    ):
        fails(["relay", *words], naming, capsys)

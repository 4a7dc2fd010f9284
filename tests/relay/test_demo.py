"""The demonstration's page does not wait for the compiler, and the commands name what is wrong."""

import asyncio
import sys
import threading
import urllib.request
from pathlib import Path

import fleet_demo
import pytest
from cli_cases import fails
from refusal_cases import refuse
from relay_cases import client, nothing

from bufgym.ground import processes
from bufgym.policies import Policy, registry
from bufgym.relay import policies


async def test_the_page_does_not_wait_for_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    compiler, compiled = threading.Event(), policies.compiled

    def slowly(chosen: Policy) -> Policy:
        assert compiler.wait(60), "waited 60 s for the page"
        return compiled(chosen)

    monkeypatch.setattr(fleet_demo, "compiled", slowly)
    async with fleet_demo.running(1, policy="drop-oldest", fades=False) as port, client(port) as viewer:
        try:

            def page() -> bytes:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=60) as answer:
                    return bytes(answer.read())

            assert b"<html" in (await asyncio.to_thread(page)).lower()
            await viewer.subscribe("^/robots/")
            assert await nothing(viewer)
        finally:
            compiler.set()
        assert (await viewer.next()).topic.startswith("/robots/robot-1/")


def test_what_is_not_kept_another_process_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, code = list[tuple[str, ...]](), 0

    def compiling(*words: str) -> int:
        asked.append(words)
        return code

    monkeypatch.setattr(policies, "kept", lambda chosen: False)
    monkeypatch.setattr(policies, "compiling", compiling)
    assert policies.compiled(registry.get("afr")).name == "afr"
    code = -2  # Ctrl-C
    refuse("policy afr: stopped while it was compiled", policies.compiled, registry.get("afr"))
    assert asked == 2 * [("bufgym.relay.policies", "fill_cache", "afr")]


def test_a_call_in_another_process(capfd: pytest.CaptureFixture[str]) -> None:
    """It finds what this one finds, it is marked, and its exit code comes back."""
    assert processes.compiling("os", "system", f"echo ${processes.COMPILES} $0") == 0
    assert capfd.readouterr().out.startswith("1 ") and sys.executable
    assert processes.compiling("sys", "exit", "wrong", quiet=True) == 1
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("words", "naming"),
    [
        (["--config", "none"], "none"),
        (["--bag", "none"], "none"),
        (["--ros", "2"], "--ros needs --config"),
        ([], "needs --bag or --ros"),
    ],
)
def test_the_command_names_what_is_wrong(
    words: list[str], naming: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    fails(["relay", "robot", *words], naming, capsys)

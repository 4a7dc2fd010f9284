"""The demonstration's page is there before its robots, and says what they wait for."""

from __future__ import annotations

import asyncio
import threading
import urllib.request

import pytest
from relay_cases import client, run

from bufgym.policies.registry import Policy
from bufgym.relay import demo, policies


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

"""What the tests of traces share."""

import time
from collections.abc import Iterator

import pytest
from http_server import Site, serving


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(time, "sleep", lambda seconds: None)  # pooch's pauses between attempts
    with serving() as site:
        yield site

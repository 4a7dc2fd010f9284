"""One relay for each module of tests, and for each test a corner of it that no other test uses."""

import itertools
import os
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.append(
    str(Path(__file__).resolve().parents[3] / "tests" / "fuzz")
)  # mutations lie beside the fuzzing of files
sys.path.append(str(Path(__file__).resolve().parents[3] / "examples"))  # the made-up robots
_NUMBERS = itertools.count(1)


@pytest.fixture(scope="session", autouse=True)
def _compiled() -> None:
    """Compile what a relay compiles before a test waits for it."""
    from relay_cases import settings

    from bufgym_relay import policies

    for name in settings().policies:
        policies.warm(name)


@pytest.fixture(scope="session", autouse=True)
def _state(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Robots keep their stops in a folder of the tests' own."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="module")
async def server(request: pytest.FixtureRequest) -> AsyncIterator[Any]:
    """The module's relay, with the settings in the module's ``CONFIG``."""
    from relay_cases import Server, settings, wait

    one = Server(getattr(request.module, "CONFIG", None) or settings())
    await wait("the module's relay", one.start())
    yield one
    await wait("its end", one.close())


@pytest.fixture
def corner(server: Any) -> Any:
    """This test's corner of the module's relay."""
    from relay_cases import Corner

    return Corner(server, next(_NUMBERS))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """The module's browser."""
    from browser_cases import browsing

    with browsing() as one:
        yield one

"""A broker of MQTT and a wire between two namespaces for the tests that want one, and quick reconnects for all."""

import contextlib
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator

import pytest
from needs import needs
from wire_cases import between  # noqa: F401  (a fixture)

from bufgym_robot import sender
from bufgym_robot.wire.sockets import free_port


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "RETRY_S", 0.01)


@pytest.fixture(scope="session", autouse=True)
def _state(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Robots at a relay keep their stops in a folder of the tests' own."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="session")
def broker_port() -> Iterator[int]:
    mosquitto = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
    if mosquitto is None:
        pytest.skip(needs("mqtt", "no mosquitto, a broker"))
    port = free_port("127.0.0.1")
    with subprocess.Popen([mosquitto, "-p", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as broker:
        try:
            while True:
                with contextlib.suppress(OSError):
                    socket.create_connection(("127.0.0.1", port), 1).close()
                    break
                assert broker.poll() is None, "mosquitto has ended"
                time.sleep(0.01)
            yield port
        finally:
            broker.kill()

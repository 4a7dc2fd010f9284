"""A relay as a service: the unit and the containers need no root, and have the files and memory of the guide."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from needs import needs

from bufgym_relay.config import Limits

DEPLOY = Path(__file__).resolve().parents[3] / "deploy"
CONNECTIONS = Limits().all_connections


def unit() -> str:
    return (DEPLOY / "relay.service").read_text(encoding="utf-8")


def test_the_unit_needs_no_root_and_has_files_for_all_connections() -> None:
    said = dict(line.split("=", 1) for line in unit().splitlines() if "=" in line and line[0] != "#")
    assert (said["DynamicUser"], said["NoNewPrivileges"], said["CapabilityBoundingSet"]) == ("yes", "yes", "")
    assert int(said["LimitNOFILE"]) > CONNECTIONS and said["MemoryMax"] == "2G"
    assert said["ExecStartPre"] == f"{said['ExecStart']} --check"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason=needs("systemd"))
def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    """With this Python for the command, which is not installed here. Of other units here it may say what it likes."""
    path = tmp_path / "bufgym-relay.service"
    path.write_text(unit().replace("/opt/bufgym/bin/bufgym", sys.executable), encoding="utf-8")
    done = subprocess.run(["systemd-analyze", "verify", str(path)], capture_output=True, text=True, check=False)
    assert not [line for line in done.stderr.splitlines() if path.name in line]


def test_the_containers_need_no_root_and_have_a_volume_each() -> None:
    services = pytest.importorskip("yaml", reason=needs("extras", "yaml")).safe_load(
        (DEPLOY / "compose.yaml").read_text(encoding="utf-8")
    )
    image = (DEPLOY / "relay.Dockerfile").read_text(encoding="utf-8")
    assert set(services) == {"services", "volumes"}
    for name, volume in (("relay", "held"), ("nats", "stream")):
        one = services["services"][name]
        assert (one["read_only"], one["cap_drop"]) == (True, ["ALL"])
        assert one["volumes"][0].partition(":")[0] == volume and volume in services["volumes"]
    relay, nats = services["services"]["relay"], services["services"]["nats"]
    assert "\nUSER relay\n" in image and not nats["user"].startswith("0")
    assert relay["build"]["dockerfile"] == "deploy/relay.Dockerfile" and relay["ulimits"]["nofile"] > CONNECTIONS
    compile(relay["healthcheck"]["test"][3], "healthcheck", "exec")

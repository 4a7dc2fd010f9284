"""What some tests need besides the Python packages that ``make test`` installs: one table, for skips and installers.

A test that cannot run here says why with ``needs``: ``pytest.skip(needs("browser"))``. ``make test`` ends with a line
for each group, and ``make everything`` installs what this machine can have. ``.ci`` reads it too, so it imports only
the standard library.
"""

import re
from dataclasses import dataclass

_GROUP = re.compile(r"needs (\w+): ")


@dataclass(frozen=True)
class Need:
    """A program, a library or a place without which some tests are skipped."""

    what: str
    """Its name for a reader."""
    apt: tuple[str, ...] = ()
    """Debian's packages."""
    pip: tuple[str, ...] = ()
    """Arguments of ``pip install -c constraints.txt``."""
    npm: str = ""
    """A package that goes to .venv/node_modules."""
    by_hand: str = ""
    """What to do where nothing above is enough; nobody does it by himself."""
    programs: tuple[str, ...] = ()
    """Commands that CI hides, to see what a first user sees."""

    @property
    def command(self) -> str:
        """What to type, or to do by hand, to have it on this machine."""
        if self.by_hand:
            return self.by_hand
        if self.apt:
            return f"apt-get install {' '.join(self.apt)}"
        if self.npm:
            return f"npm install --prefix .venv {self.npm}"
        return f".venv/bin/python -m pip install -c constraints.txt {' '.join(self.pip)}"


_ROS1 = ("python3-rospy", "python3-rosmaster", "python3-sensor-msgs", "python3-nav-msgs")
_BUILD = ("gcc", "cc", "clang", "g++", "c++", "cmake", "pkg-config")

NEEDS = {
    "extras": Need("Python packages of the extras", by_hand="touch pyproject.toml && make .venv/.ready"),
    "torchrl": Need("TorchRL", pip=("torchrl==0.14.1",)),
    "trainers": Need("other libraries that train, each in its environment", by_hand="make trainers"),
    "ray": Need("Ray", by_hand=".venv/bin/python -m pip install -c constraints.txt -e .[ray]"),
    "browser": Need("pages in a browser", apt=("chromium",), programs=("chromium",)),
    "mqtt": Need("MQTT", apt=("mosquitto",), programs=("mosquitto",)),
    "nats": Need("relays over NATS", apt=("nats-server",), programs=("nats-server",)),
    "ros1": Need("ROS 1", apt=_ROS1, programs=("rosmaster", "roscore")),
    "roscpp": Need(
        "ROS 1 in C++",
        apt=("g++", "cmake", "pkg-config", *_ROS1, "libroscpp-dev", "libnav-msgs-dev", "libsensor-msgs-dev"),
    ),
    "ros2": Need("ROS 2", pip=("-e", "packages/robot[ros2]")),
    "rclcpp": Need("ROS 2 in C++", by_hand="run .venv/bin/python .ci/rclcpp.py, which builds it (minutes, once)"),
    "rclcpp_build": Need("rclcpp's build", apt=("git", "g++", "cmake", "libtinyxml2-dev", "libconsole-bridge-dev")),
    "compiler": Need("C and C++ compilers", apt=("gcc", "g++", "clang", "cmake"), programs=_BUILD),
    "zig": Need("zig's C compiler", pip=("ziglang==0.17.1",)),
    "qemu": Need("programs for arm64", apt=("qemu-user",), programs=("qemu-aarch64",)),
    "tunnel": Need("links with a round trip", apt=("iproute2",), programs=("ip",)),
    "root": Need("links with a round trip", by_hand="run as root, with /dev/net/tun (docker run --privileged)"),
    "data": Need("recorded data", by_hand="set BUFGYM_SHARED_DATA to the folder of recordings"),
    "node": Need("the example in JavaScript", apt=("nodejs",), programs=("node", "nodejs")),
    "typescript": Need("types of the page", npm="typescript@5.9.3", programs=("npm", "tsc")),
    "sqlite": Need("files in SQLite's own program", apt=("sqlite3",), programs=("sqlite3",)),
    "systemd": Need("the unit of systemd", by_hand="apt-get install systemd", programs=("systemd-analyze",)),
    "git": Need("the checkout itself", by_hand="git clone, in place of an archive"),
    "system": Need("another operating system", by_hand="run them on Linux"),
    "compiled": Need("compiled kernels", by_hand="unset BUFGYM_KERNELS"),
}
"""Group -> what it is and how to have it."""


def needs(group: str, why: str = "") -> str:
    """The reason for a skip: the group, and what exactly is missing."""
    return f"needs {group}: {why or NEEDS[group].what}"


def group_of(reason: str) -> str | None:
    """The group that the reason names; None if it names none of the table."""
    found = _GROUP.search(reason)
    return found[1] if found and found[1] in NEEDS else None

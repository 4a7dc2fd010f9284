"""Commands of a robot start in a second: the compiler is not even loaded. Each runs here as a user starts it."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from bufgym_live.commands import LIVE, ROS2
from bufgym_live.robot.sockets import free_port

COMPARED = {"live validate", "live replay", "live cost"}
"""Commands that run the simulator, compiled."""
TELLS = """
import sys
from bufgym.cli import main
try:
    code = main(sys.argv[1:])
except KeyboardInterrupt:
    code = 130
print(code, "numba" in sys.modules, file=sys.stderr)
"""


class Program:
    """A command in a process of its own, which tells at its end whether Numba was loaded."""

    def __init__(self, words: str, without: str = "") -> None:
        hidden = f"import sys; sys.modules[{without!r}] = None\n" if without else ""
        command = [sys.executable, "-uc", hidden + TELLS, *words.split()]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.out = self.process.stdout

    def ended(self) -> str:
        """The exit code, and whether Numba was loaded."""
        _, err = self.process.communicate(timeout=60)
        return err.splitlines()[-1]


def test_every_command_is_one_or_the_other() -> None:
    """A new command is tested here, or compares with the simulator."""
    commands = {f"live {name}" for name in LIVE[1]} | {f"ros2 {name}" for name in ROS2[1]}
    assert commands == COMPARED | {"live send", "live receive", "live link", "live view", "ros2 send", "ros2 receive"}


def test_both_ends_the_link_between_and_a_view_load_no_compiler(tmp_path: Path) -> None:
    """Ten messages over a link, and the sender's log as text."""
    there, here, log = free_port("127.0.0.1"), free_port("127.0.0.1"), tmp_path / "log.mcap"
    receiving = Program(f"live receive 127.0.0.1:{there} --messages 10")
    link = Program(f"live link --trace lte-synthetic-0 --to 127.0.0.1:{there} --port {here}")
    assert "listening" in receiving.out.readline() and "127.0.0.1" in link.out.readline()
    frames = "--size 100 --rate 100 --duration 0.1 --capacity 16"
    assert Program(f"live send 127.0.0.1:{here} {frames} --log {log}").ended() == "0 False"
    assert receiving.ended() == "0 False"
    link.process.send_signal(signal.SIGINT)
    assert link.ended().endswith(" False")
    assert Program(f"live view {log}").ended() == "0 False"


def test_an_export_to_c_compiles_nothing(tmp_path: Path) -> None:
    """A library's header has no calls of an episode, which the simulator would play; a header alone has them."""
    library, alone = tmp_path / "library", tmp_path / "afr.h"
    assert Program(f"export afr,learned {library} --to ros2").ended() == "0 False"
    assert Program(f"export afr {alone} --to c").ended() == "0 False"
    assert "_parity(" not in (library / "p_afr.h").read_text() and "bufgym_parity(" in alone.read_text()


@pytest.mark.parametrize("words", ["send --ros-args -p topics:=[a]", "receive --port 0"])
def test_the_relay_of_ros_2_loads_no_compiler(words: str) -> None:
    """All its modules are imported before it finds that rclpy is not there; with rclpy it is measured at night."""
    _, err = Program(f"ros2 {words}", without="rclpy").process.communicate(timeout=60)
    assert "needs rclpy" in err and err.splitlines()[-1] == "2 False"

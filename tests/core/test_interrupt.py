"""Ctrl-C is answered within a second while a kernel works, and what a kernel's thread raises arrives."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from bufgym.ground.kernel import JIT, interruptible

LONG = """
import signal

import numpy as np
from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.oracle import clairvoyant
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.traces import Trace

V = qoi.exponential()
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it


def episode(n, bytes_per_s):
    return Episode(messages(np.arange(n) * 33_333, 230_000), Link(Trace.constant(bytes_per_s, 100)))


def far(buffer, arrival, memory):
    least = 0.0
    for k in range(20_000_000):
        least += np.sin(memory[0] + k)
    return -1 if least < 0 else -2


far = policies.Policy("far", far, compile=True)
tasks = {
    "rollout": lambda n: run(far, [episode(n, 1e6)], 5, V),
    "clairvoyant": lambda n: clairvoyant(episode(n, 1e4), 50, V),
}
"""


@pytest.mark.skipif(not JIT, reason="Python's own loops are interrupted anyway")
@pytest.mark.parametrize(("task", "warm", "n"), [("rollout", 1, 10**6), ("clairvoyant", 2_000, 10**5)])
def test_ctrl_c_is_answered_within_a_second(task: str, warm: int, n: int, tmp_path: Path) -> None:
    """After a short run (so that nothing is left to compile) each would take minutes."""
    program = tmp_path / "long.py"
    program.write_text(f"{LONG}\ntasks[{task!r}]({warm})\nprint('begins', flush=True)\ntasks[{task!r}]({n})\n")
    process = subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "begins\n"
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(2)  # it is at work
        os.kill(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=30)  # minutes without it; a busy machine may take more than a second
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == -signal.SIGINT
    assert said.rstrip().endswith("KeyboardInterrupt")


def test_the_result_and_the_error_arrive() -> None:
    assert interruptible(lambda: threading.current_thread()) is not threading.main_thread()
    with pytest.raises(ZeroDivisionError):
        interruptible(lambda: 1 // (len(np.zeros(1)) - 1))

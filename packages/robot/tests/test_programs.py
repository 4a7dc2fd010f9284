"""The programs of an episode on ROS, without ROS."""

import asyncio
import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import compiled
from needs import needs
from refusal_cases import refuse

from bufgym import policies
from bufgym.cli import main
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym_papers.figures import figure, run_live
from bufgym_robot import programs as live
from bufgym_robot.programs import pose_stamp, publish_in_time, received, running
from bufgym_robot.ros1 import episode as ros1
from bufgym_robot.ros2 import episode as ros2
from bufgym_robot.wire.odometry import Odometry

EPISODE = Episode(
    messages(np.array([0, 20_000, 60_000]), np.array([5, 6, 7]), np.array([0.0, 0.25, 1.5])),
    Link(Trace.steps([(1.0, 1e6)])),
)


def echoes(parent: Connection) -> None:
    while True:
        parent.send(parent.recv())


def fails(_: Connection) -> None:
    raise BufgymError("no such thing")


def ends(_: Connection) -> None:
    pass


def test_a_program_is_spoken_to_and_may_be_silent_and_who_waits_hears_that_another_has_failed() -> None:
    for work, words in ((fails, "other: no such thing"), (ends, "other: has ended")):
        with running(echo=echoes, other=work) as (echo, _), pytest.raises(BufgymError, match=words):
            asyncio.run(echo.receive())
    with running(echo=echoes) as (echo,):
        echo.send({"port": 3})
        assert asyncio.run(echo.receive()) == {"port": 3}
        refuse(r"echo: said nothing for 0\.01 s", asyncio.run, echo.receive(patience_s=0.01))


PARENT = """
import multiprocessing, os, signal, sys, threading, time
from bufgym_robot.programs import running
ours = signal.signal
signal.signal = lambda *what: (time.sleep(float(sys.argv[1])), ours(*what))  # the program's first step
with running(idle=lambda parent: threading.Event().wait()):
    print(multiprocessing.active_children()[0].pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.nightly
@pytest.mark.parametrize("begins_after_s", ["0", "1"])
def test_no_program_outlives_a_parent_that_was_killed(begins_after_s: str) -> None:
    """Nor where the parent was gone before the program had begun."""
    words = [sys.executable, "-c", PARENT, begins_after_s]
    printed = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    state = Path(f"/proc/{int(printed.stdout)}/stat")
    with contextlib.suppress(FileNotFoundError):
        for _ in range(600):
            if state.read_text().rpartition(")")[2].split()[0] == "Z":  # ended, but nobody has asked for it
                return
            time.sleep(0.1)
        pytest.fail("it is still there")


def test_each_frame_comes_in_time_after_a_pose_that_says_its_x(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pose 10 ms before its frame, or at once where that has passed; a call takes 1 ms."""
    odometry, done, now_s = Odometry(), list[tuple[Any, ...]](), 100.0

    def passes(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds

    def move(k: int, metres: float) -> None:
        seconds, nanoseconds = pose_stamp(k)
        odometry(seconds + nanoseconds / 1e9, (metres, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        done.append(("move", k, round(now_s, 4)))
        passes(0.001)

    def show(k: int, size_bytes: int) -> None:
        done.append(("show", size_bytes, round(now_s, 4), round(odometry.x, 9)))
        passes(0.001)

    monkeypatch.setattr(live.time, "sleep", passes)
    monkeypatch.setattr(live.time, "monotonic", lambda: now_s)
    publish_in_time(EPISODE, 100.0, move, show)
    assert done == [
        ("move", 0, 100.0),
        ("show", 5, 100.001, 0.0),
        ("move", 1, 100.01),
        ("show", 6, 100.02, 0.25),
        ("move", 2, 100.05),
        ("show", 7, 100.06, 1.5),
    ]


def test_what_came_is_told_as_messages_of_the_episode_in_real_time() -> None:
    came = received([(0, 2_030_000_000), (2, 2_090_000_000)], EPISODE, 2.0)
    assert [(one.number, one.seq, one.at_us, one.x, one.received_ns) for one in came] == [
        (0, 0, 0, 0.0, 30_000_000),
        (1, 2, 60_000, 1.5, 90_000_000),
    ]
    for play in (ros1.play, ros2.play):
        refuse("speed = 2: must be 1 with ROS", play, policies.get("afr"), EPISODE, 4, qoi.exponential(), speed=2.0)


# Robofleet's figures on real sockets: the same messages, and what became of them.

SMALL: dict[str, dict[str, Any]] = {
    "robofleet-fig3": {"rates_hz": (10,), "duration_s": 0.5},
    "robofleet-fig4": {"dropouts_s": (1,), "links_mbit_per_s": (12,), "kinds": ("LaserScan",), "live": 20.0},
    "robofleet-fig5": {"fall_s": 2.0, "stay_s": 0.0, "points": 500},
    "robofleet-fig6": {"points": (100,), "max_consumers": 2, "duration_s": 1.0},
    "robofleet-fig7": {"bad_from": 5, "bad_s": 1.0, "after_s": 1.0},
}
"""Options that keep each short; one that is played live must add its own."""


@compiled
@pytest.mark.nightly
@pytest.mark.parametrize("name", SMALL)
def test_each_is_played_live(name: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason=needs("extras", "matplotlib"))
    expected, steps = list[tuple[int, float]](), list[int]()

    @contextmanager
    def watch(runs: int, takes_s: float) -> Iterator[Callable[[], None]]:
        expected.append((runs, takes_s))
        yield lambda: steps.append(1)

    text = run_live(name, tmp_path, watch, **SMALL[name])
    ((runs, takes_s),) = expected
    assert len(steps) == runs  # a picture of runs that were played plays none again
    if name == "robofleet-fig6":  # one and two consumers, three programs, 1 s each: what comes later is not awaited
        assert (runs, takes_s) == (6, 6.0)
    assert "Live, beside simulated:\n  " in text
    for medium in ("simulated", "live"):
        assert str(tmp_path / f"{name}-{medium}.csv") in text
        assert (tmp_path / f"{name}-{medium}.png").is_file()


@compiled
@pytest.mark.nightly
def test_on_an_easy_link_nothing_is_dropped_live_either() -> None:
    """Five clouds of 160 kB (JSON: 562 kB), 250 ms apart, over 2.5 MB/s: each program sends each of them.

    A link so slow that the 5 ms which it may be ahead after a pause (``live/shaped.py``) are less than a tenth.
    """
    settings = {"rates_hz": (4,), "mbit_per_s": 20.0, "duration_s": 1.25, "runs": 1}
    rows = figure("robofleet-fig3", **settings, live=1.0).simulate()
    assert [row["dropped"] for row in rows] == [0] * 5
    # No sooner than the link carries them, and half a round trip later: 64 ms and 225 ms, and 5 ms.
    least_ms = {row["sender"]: 230.0 if row["sender"] == "rosbridge" else 69.0 for row in rows}
    assert all(row["latency_ms"] > 0.9 * least_ms[row["sender"]] for row in rows)


@compiled
def test_the_command_says_how_far_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from bufgym_papers.figures.robofleet_fig5 import Reproduction

    monkeypatch.setattr(Reproduction, "LIVE", {**Reproduction.LIVE, **SMALL["robofleet-fig5"], "live": 8.0})
    assert main(["reproduce", "robofleet-fig5", "--live", "--out", str(tmp_path)]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("robofleet-fig5: ")]
    assert lines == [
        "robofleet-fig5: 4 runs on real sockets take about 1 s",  # 2 s, four programs, eight times as fast
        *(f"robofleet-fig5: run {k} of 4" for k in (1, 2, 3, 4)),
    ]

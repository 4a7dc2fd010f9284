"""Programs of an episode on ROS: nodes and relays, each in a process of its own.

They are forked from this process, so that any policy comes along unchanged and nothing is compiled again.
"""

from __future__ import annotations

import asyncio
import importlib
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, Final

from bufgym.scenario import Episode
from bufgym.traces import MotionSettings
from bufgym.utils.errors import BufgymError
from bufgym.utils.processes import end_with
from bufgym_robot.receiver import Received
from bufgym_robot.wire.queue import PolicyQueue

CAMERA, ODOMETRY = "/camera", "/odom"
"""The topics: ``CompressedImage``, whose ``format`` is the frame's number, and ``PoseStamped``."""
SILENCE_S: Final = 120.0  # Longest wait for anything
LEAD_S: Final = 0.01  # Time by which a pose is sent before its frame, because the two use different sockets
START_S: Final = 0.3  # Time from the command to begin to the beginning
_POLL_S: Final = 0.02


class Worker:
    """A process that runs ``work`` with one end of a pipe to this process."""

    def __init__(self, name: str, work: Callable[[Connection], None], workers: list[Worker]) -> None:
        """``workers`` lists all programs of a run."""
        self._name, self._workers = name, workers
        self._words, words = Pipe()
        self._failures, failures = Pipe(duplex=False)
        fork = multiprocessing.get_context("fork")
        self._process = fork.Process(target=_run, args=(work, words, failures, os.getpid()), daemon=True)
        self._process.start()
        words.close()
        failures.close()

    def send(self, words: Any) -> None:
        """Send words to the program."""
        self._words.send(words)

    async def receive(self, patience_s: float = SILENCE_S) -> Any:
        """Wait for the program's next words.

        Raises:
            BufgymError: one of the programs failed or ended, or this one stayed silent for ``patience_s``.
        """
        deadline_s = time.monotonic() + patience_s
        while not self._words.poll():
            for one in self._workers:
                one.check()
            if time.monotonic() > deadline_s:
                raise BufgymError(f"{self._name}: said nothing for {patience_s:g} s")
            await asyncio.sleep(_POLL_S)
        try:
            return self._words.recv()
        except EOFError:
            self.check()
            raise

    def check(self) -> None:
        """Raise an error if it has ended."""
        if self._failures.poll():
            try:
                failure = self._failures.recv()
            except EOFError:
                failure = "has ended before its time"
            raise BufgymError(f"{self._name}: {failure}")

    def end(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.join()
        self._words.close()
        self._failures.close()


def _run(work: Callable[[Connection], None], words: Connection, failures: Connection, parent: int) -> None:
    """Run in the program; ``parent`` comes from the caller, as a killed parent may already have been replaced."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends us
    end_with(parent)
    os.environ["PYTHONWARNINGS"] = "ignore"
    try:
        work(words)
    except Exception as error:
        failures.send(str(error) if isinstance(error, BufgymError) else f"{type(error).__name__}: {error}")
    os._exit(0)  # skips waiting for ROS's threads


@contextmanager
def running(**works: Callable[[Connection], None]) -> Iterator[list[Worker]]:
    """Run programs by name while the block runs."""
    if not hasattr(os, "fork"):
        raise BufgymError("episodes on ROS need a system whose processes fork, such as Linux")
    workers: list[Worker] = []
    try:
        for name, work in works.items():
            workers.append(Worker(name, work, workers))
        yield workers
    finally:
        for one in workers:
            one.end()


def check_messages(mark: str) -> None:
    """Import the message packages; raise an error if they lack ``mark`` and so belong to the other ROS."""
    for package, name in (("geometry_msgs", "PoseStamped"), ("sensor_msgs", "CompressedImage")):
        if not hasattr(getattr(importlib.import_module(f"{package}.msg"), name), mark):
            raise BufgymError(f"{package}: is the other ROS's here: each ROS wants a Python of its own")


def check_speed(speed: float) -> None:
    if speed != 1:
        raise BufgymError(f"speed = {speed:g}: must be 1 with ROS, whose nodes live in real time")


def publish_in_time(
    episode: Episode, began_s: float, move: Callable[[int, float], None], show: Callable[[int, int], None]
) -> None:
    """Call ``move(frame, metres along a straight way)`` and ``show(frame, bytes)`` when the episode's messages arrive.

    The sum of these poses, as ``live.odometry`` computes it, is the episode's x when the frame comes.
    """
    scale_m = MotionSettings().scene_scale_m
    for k, message in enumerate(episode.arrivals):
        at_s = began_s + int(message["arrival_us"]) / 1e6
        time.sleep(max(0.0, at_s - LEAD_S - time.monotonic()))
        move(k, float(message["x"]) * scale_m)
        time.sleep(max(0.0, at_s - time.monotonic()))
        show(k, int(message["size_bytes"]))


def pose_stamp(k: int) -> tuple[int, int]:
    """Time stamp (s, ns) of frame ``k``'s pose, spaced as ``MotionSettings`` requires."""
    whole_s, rest = divmod(k, round(MotionSettings().rate_hz))
    return 100 + whole_s, round(rest * 1e9 / MotionSettings().rate_hz)


def drained(queue: PolicyQueue, put: int) -> int:
    """Wait until every message put has left or been dropped; return how many have left."""
    while len(queue) or queue.in_flight:
        time.sleep(_POLL_S)
    return put - queue.dropped


class Seen:
    """Frames received, with their times."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, int]] = []
        self._latest_s = time.monotonic()

    def take(self, frame: Any) -> None:
        """Note a frame; a subscriber's callback."""
        self.frames.append((int(frame.format), time.monotonic_ns()))
        self._latest_s = time.monotonic()

    def wait(self, frames: int, patience_s: float = SILENCE_S) -> None:
        """Wait until this many frames have come, or none has come for ``patience_s``."""
        self._latest_s = time.monotonic()
        while len(self.frames) < frames and time.monotonic() - self._latest_s < patience_s:
            time.sleep(_POLL_S)


def received(frames: list[tuple[int, int]], episode: Episode, began_s: float) -> list[Received]:
    """List the episode's messages that were received."""
    rows: list[tuple[int, float, int]] = episode.arrivals[["arrival_us", "x", "topic"]].tolist()
    began_ns = round(began_s * 1e9)
    return [Received("", n, k, *rows[k], b"", at_ns - began_ns) for n, (k, at_ns) in enumerate(frames)]

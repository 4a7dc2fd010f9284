"""What all tests share: where the recorded data lie, and how hard Hypothesis tries.

Hypothesis profiles, chosen by the environment variable HYPOTHESIS_PROFILE:

- ``ci`` (default): the same examples in every run, no deadline (the first call of a kernel compiles it), and
  fewer examples where compilation is off;
- ``thorough``: new examples in each run, and many.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

from bufgym import kernel

kernel.compile_silently()  # tests count lines on stderr

SECOND_TRY = ("tests/live", "tests/relay")
"""Tests with clocks and real sockets: on a busy machine a peer may be late. The summary names who needed it."""

REPO = Path(__file__).resolve().parent.parent
COMPILED = os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")

settings.register_profile("ci", deadline=None, max_examples=100 if COMPILED else 20, derandomize=True, database=None)
settings.register_profile("thorough", deadline=None, max_examples=2000 if COMPILED else 200)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.relative_to(REPO).as_posix().startswith(SECOND_TRY):
            item.add_marker(pytest.mark.flaky(reruns=1))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded traces and trajectories, too big for the repository; skips where it is absent.

    ``$BUFGYM_SHARED_DATA`` where that is set, else ``shared/data`` beside the checkout.
    """
    named = os.environ.get("BUFGYM_SHARED_DATA")
    folder = Path(named) if named else REPO.parent / "shared" / "data"
    if not folder.is_dir():
        where = "$BUFGYM_SHARED_DATA" if named else "shared/data beside the checkout"
        pytest.skip(f"recorded data absent: {where} is no folder (set BUFGYM_SHARED_DATA)")
    return folder


@pytest.fixture(scope="session")
def ros(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment in which a process of this Python has ROS 1."""
    from ros1_cases import environment

    where = environment(tmp_path_factory.mktemp("ros"))
    names = "rospy, rosmaster, sensor_msgs.msg, nav_msgs.msg"
    done = subprocess.run(
        [sys.executable, "-c", f"import {names}"], env=where, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip(f"ROS 1 (python3-rospy and others) is not here: {done.stderr.strip().splitlines()[-1]}")
    return where

"""Shared by all tests: the recorded data, and the number of examples that Hypothesis tries.

The environment variable HYPOTHESIS_PROFILE chooses a profile. No test has a number of its own.

- ``commit`` (default): few examples, the same in every run;
- ``nightly``: many examples, new ones in every run. Failures are kept in ``.hypothesis`` and tried first next time.

A profile has fewer examples where compilation is off, because kernels are some hundred times slower there. No example
has a deadline: the first call of a kernel compiles it.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from recording_cases import recorded_data

from bufgym.ground import kernel
from bufgym.policies import registry

kernel.compile_silently()  # tests count lines on stderr

REPO = Path(__file__).resolve().parent
COMPILED = os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")

# A busy machine draws examples slowly; that is no failure.
patient = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
few, many = (25, 200) if COMPILED else (8, 30)
settings.register_profile("commit", patient, max_examples=few, derandomize=True, database=None)
settings.register_profile("nightly", patient, max_examples=many, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "commit"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded data, which holds what may not be passed on; skips where it is absent."""
    folder = recorded_data()
    if not folder.is_dir():
        pytest.skip("recorded data absent: BUFGYM_SHARED_DATA must name a folder of files that may not be published")
    return folder


@pytest.fixture
def own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Policies that the test registers are gone after it."""
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))


@pytest.fixture(scope="session")
def ros(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment in which a process of this Python has ROS 1."""
    from ros1_cases import environment

    where = environment(tmp_path_factory.mktemp("ros"))
    command = [sys.executable, "-c", "import rospy, rosmaster, sensor_msgs.msg, nav_msgs.msg"]
    done = subprocess.run(command, env=where, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"ROS 1 (python3-rospy and others) is not here: {done.stderr.strip().splitlines()[-1]}")
    return where

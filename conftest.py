"""Shared by all tests: the recorded data, and the number of examples that Hypothesis tries.

The environment variable HYPOTHESIS_PROFILE chooses a profile. No test has a number of its own.

- ``commit`` (default): few examples, the same in every run;
- ``nightly``: many examples, new ones in every run. Failures are kept in ``.hypothesis`` and tried first next time.

A profile has fewer examples where compilation is off, because kernels are some hundred times slower there. No example
has a deadline: the first call of a kernel compiles it.
"""

import json
import os
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from needs import needs
from recording_cases import recorded_data
from registries import forgotten, restored

from bufgym.jit import JIT

REPO = Path(__file__).resolve().parent

# A busy machine draws examples slowly; that is no failure.
patient = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
few, many = (25, 200) if JIT else (8, 30)
settings.register_profile("commit", patient, max_examples=few, derandomize=True, database=None)
settings.register_profile("nightly", patient, max_examples=many, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "commit"))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Write which tests were skipped, and why, to the file that BUFGYM_SKIPPED names."""
    if named := os.environ.get("BUFGYM_SKIPPED"):
        skipped = {report.nodeid: report.longrepr[-1] for report in terminalreporter.stats.get("skipped", [])}
        Path(named).write_text(json.dumps(skipped, indent=0), encoding="utf-8")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded data, which holds what may not be passed on; skips where it is absent."""
    folder = recorded_data()
    if not folder.is_dir():
        pytest.skip(needs("data", "BUFGYM_SHARED_DATA must name a folder of files that may not be published"))
    return folder


@pytest.fixture(autouse=True)
def no_trace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Policies, fields, terms, scenarios and all else that the test registers are gone after it, and its modules."""
    with restored(), forgotten(tmp_path_factory.getbasetemp()):
        yield


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Refuse a test file that registers something as it is imported: all other files' tests would find it."""
    with restored() as changed:
        report = yield
    if changed and isinstance(collector, pytest.Module):
        report.outcome = "failed"
        report.longrepr = f"{collector.nodeid} registers as it is imported, and must in a fixture: {'; '.join(changed)}"
    return report


@pytest.fixture(scope="session")
def ros(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment in which a process of this Python has ROS 1."""
    from ros1_cases import environment

    where = environment(tmp_path_factory.mktemp("ros"))
    command = [sys.executable, "-c", "import rospy, rosmaster, sensor_msgs.msg, nav_msgs.msg"]
    done = subprocess.run(command, env=where, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(needs("ros1", done.stderr.strip().splitlines()[-1]))
    return where

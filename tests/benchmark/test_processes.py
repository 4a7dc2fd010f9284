"""A sweep's processes: a folder is one run's, workers end with their parent, and one that dies costs one line."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_cases import fails, shown
from needs import needs
from sweep_cases import THREE, bufgym, ended

from bufgym.utils.files import locked

pytest.importorskip("joblib", reason=needs("extras", "joblib"))

POLICY = """
import os, signal, time
from pathlib import Path
from bufgym.policies import ACCEPT, REJECT, register

@register("{name}")
def {name}(buffer, arrival, memory):
    \"\"\"Accept where there is room.\"\"\"
    {body}
    return ACCEPT if len(buffer.slots) < buffer.capacity else REJECT
"""


def words(policy: Path, out: Path) -> list[object]:
    sweep = ["bench", "--suite", "interruption-v1", "--policies", policy.stem, "--capacity", 2, "--seeds", 1]
    return [*sweep, "--policy-file", policy, "--format", "csv", "--jobs", 2, "--out", out]


def policy_file(folder: Path, name: str, body: str) -> Path:
    file = folder / f"{name}.py"
    file.write_text(POLICY.format(name=name, body=body), encoding="utf-8")
    return file


def wait_for(ended: Callable[[], bool]) -> bool:
    """Whether it comes true; as long as a busy machine may take."""
    for _ in range(300):
        if ended():
            return True
        time.sleep(0.1)
    return False


def session_ended(number: int) -> bool:
    try:
        os.killpg(number, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.nightly
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent(how: signal.Signals, tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    body = f"Path({str(begun)!r}).touch(); time.sleep(0.5)"
    process = bufgym(*words(policy_file(tmp_path, "sleepy", body), tmp_path / "out"))
    while not begun.exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.send_signal(how)
    process.wait()
    if not wait_for(lambda: session_ended(process.pid)):
        os.killpg(process.pid, signal.SIGKILL)
        pytest.fail("workers live on")
    assert "Traceback" not in process.communicate()[1]


def test_a_worker_whose_parent_is_gone_before_it_begins_ends() -> None:
    late = "import os, time; from bufgym.utils.processes import end_with; end_with(os.getpid()); time.sleep(600)"
    assert subprocess.run([sys.executable, "-c", late], check=False).returncode == 1


@pytest.mark.nightly
def test_a_worker_that_dies_is_one_line_and_a_retry(tmp_path: Path) -> None:
    dead = tmp_path / "dead"
    body = f"Path({str(dead)!r}).exists() or (Path({str(dead)!r}).touch(), os.kill(os.getpid(), signal.SIGKILL))"
    code, out, err = ended(*words(policy_file(tmp_path, "frail", body), tmp_path / "out"))
    assert code == 0, err
    lines = [line for line in err.splitlines() if line.strip() and "shard/s" not in line]  # its progress
    assert len(lines) == 1 and lines[0].startswith("bufgym: a worker process ended before its work did"), err
    assert (tmp_path / "out" / "rows.csv").exists() and "frail" in out


def test_two_runs_do_not_share_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bench", "--suite", "interruption-v1", "--policies", THREE[0], "--capacity", 2, "--seeds", 1]
    command += ["--backend", "sequential", "--format", "csv", "--out", tmp_path]
    with locked(tmp_path):
        fails(command, f"{tmp_path}: another process is writing there", capsys)
    assert not list(tmp_path.iterdir())
    shown(command, capsys)
    assert ".lock" not in {path.name for path in tmp_path.iterdir()}

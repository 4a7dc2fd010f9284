"""Does the sdist in ``dist`` stand alone? Its own tests, a quick part, run on its own sources in an empty folder.

The compiled kernels are those of this machine's wheel, which ``make dist`` builds from the sdist.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

BUILT = "bufgym/kernels/built/"
REPO = Path(__file__).resolve().parent.parent
TESTS = ("tests/core/test_sender.py", "tests/core/test_policies.py", "tests/envs/test_single.py", "tests/test_cli.py")


def main() -> int:
    """The exit code of pytest there."""
    (archive,) = (REPO / "dist").glob("bufgym-*.tar.gz")
    (wheel,) = (REPO / "dist").glob(f"bufgym-*_{platform.machine()}.whl")
    with tempfile.TemporaryDirectory() as name:
        with tarfile.open(archive) as file:
            file.extractall(name, filter="data")
        (folder,) = Path(name).iterdir()
        with zipfile.ZipFile(wheel) as packed:
            packed.extractall(folder, [file for file in packed.namelist() if file.startswith(BUILT)])
        data = os.environ.get("BUFGYM_SHARED_DATA", str(REPO.parent / "shared" / "data"))
        given = {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1", "BUFGYM_SHARED_DATA": data}
        command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "-m", "not nightly", *TESTS]
        return subprocess.run(command, cwd=folder, env={**os.environ, **given}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())

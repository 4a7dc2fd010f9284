"""CI is a first user: ``make test`` in a fresh clone that sees no program or Debian package that tests use besides.

With arguments it installs all of these for this checkout and runs ``make`` with them: ``.ci/run test``, and
``.ci/run nightly`` each night.
"""

import atexit
import glob
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPO / "tests"))

from needs import NEEDS  # noqa: E402

FOLDERS = "/usr/lib/python3/dist-packages", "/opt/ros", "/usr/include/ros", "/usr/share/ros*"
OURS = ("BUFGYM_", "ROS_", "AMENT_", "CMAKE_PREFIX", "PYTHONPATH")
"""Beginnings of environment variables that a first user does not have."""


def as_first_user(command: list[str]) -> list[str]:
    """The command where folders of Debian's packages are empty and their programs cannot be executed."""
    folders = [path for pattern in FOLDERS for path in glob.glob(pattern) if os.path.isdir(path)]
    named = {shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin") for n in NEEDS.values() for name in n.programs}
    # Debian's names are links: g++ to x86_64-linux-gnu-g++-14.
    programs = sorted({os.path.realpath(path) for path in named if path})
    empty = tempfile.mkdtemp()
    atexit.register(os.rmdir, empty)
    mounts = [f"mount --bind {empty} {shlex.quote(path)}" for path in folders]
    mounts += [f"mount --bind /dev/null {shlex.quote(path)}" for path in programs]
    hidden = ["unshare", "--mount", "--propagation", "private", "sh", "-c", " && ".join([*mounts, 'exec "$@"']), "sh"]
    probe = subprocess.run([*hidden, "true"], capture_output=True, text=True, check=False) if mounts else None
    if probe and probe.returncode:
        print(f"could not hide {' '.join([*folders, *programs])}: {probe.stderr.strip()}", flush=True)
        return command
    print(f"hidden from the first run: {' '.join([*folders, *programs]) or 'nothing is here'}", flush=True)
    return [*hidden, *command]


def make(*words: str, folder: Path = REPO, hide: bool = False) -> int:
    """The exit code of make."""
    command = ["make", "--no-print-directory", *words]
    own = {name: value for name, value in os.environ.items() if not (hide and name.startswith(OURS))}
    return subprocess.run(as_first_user(command) if hide else command, cwd=folder, env=own, check=False).returncode


def main(words: list[str]) -> int:
    """The exit code of the first part that fails, or 0."""
    if words:
        if code := make(".venv/.ready"):
            return code
        install = [".venv/bin/python", ".ci/missing.py", "install", "all", os.devnull]
        return subprocess.run(install, cwd=REPO, check=False).returncode or make(*words)
    if subprocess.run(["git", "status", "--porcelain"], cwd=REPO, capture_output=True, check=False).stdout:
        print("what is not committed is not in the clone", flush=True)
    clone = Path(tempfile.mkdtemp(prefix="bufgym-")) / "bufgym"
    try:
        subprocess.run(["git", "clone", "--quiet", str(REPO), str(clone)], check=True)
        # In the order of files: other orders are for people, who can look for what an order brought to light.
        os.environ.setdefault("PYTEST_ADDOPTS", "-p no:randomly")
        given = [f"PYTEST_ARGS={os.environ['PYTEST_ARGS']}"] if "PYTEST_ARGS" in os.environ else []
        return make("test", *given, folder=clone, hide=True)
    finally:
        shutil.rmtree(clone.parent)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

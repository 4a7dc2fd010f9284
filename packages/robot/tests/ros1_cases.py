"""Where ROS 1 is, and how nodes of either ROS are run as programs."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parents[3]
SYSTEM = Path("/usr/lib/python3/dist-packages")
"""Where Debian has rospy, which is plain Python: behind this interpreter's own packages it runs here too."""


def environment(folder: Path) -> dict[str, str]:
    """ROS 1's own packages stand before this interpreter's: ROS 2 calls its messages by the same names."""
    own = folder / "own"
    own.mkdir()
    for pattern in ("ros*", "gen*", "*_msgs", "*_srvs"):
        for package in SYSTEM.glob(pattern):
            if package.is_dir() and not (own / package.name).exists():
                (own / package.name).symlink_to(package)
    places = [
        REPO,
        REPO / "packages" / "robot",
        own,
        *(place for place in sys.path if place.endswith("site-packages")),
        SYSTEM,
    ]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, places)), "ROS_LOG_DIR": str(folder)}


def played(where: dict[str, str], *words: Any) -> str:
    """What a program of this Python prints, which ends well."""
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, env=where, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout

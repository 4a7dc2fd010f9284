"""Where ROS 1 is, for the tests that run nodes of it."""

import os
import sys
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]
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
    places = [REPO, own, *(place for place in sys.path if place.endswith("site-packages")), SYSTEM]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, places)), "ROS_LOG_DIR": str(folder)}

"""ROS 2 in C++: the source of the ament package ``bufgym_sender``, a node with a policy's queue for each topic."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bufgym.policies import Policy
from bufgym_robot import roscpp

_SOURCE: Final = Path(__file__).with_name("source")


def write(folder: str | Path, chosen: Sequence[Policy]) -> Path:
    """Write the package with these policies to a folder, which colcon builds.

    Raises:
        BufgymError: a policy has no C, or the folder cannot be written.
    """
    own = {str(file.relative_to(_SOURCE)): file for file in _SOURCE.rglob("*.*") if file.suffix != ".pyc"}
    return roscpp.write(folder, chosen, {**roscpp.SHARED, **own})

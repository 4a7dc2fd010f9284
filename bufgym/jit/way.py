"""How kernels run: as C, as C that tests every index and every sum, or as plain Python."""

import os

from bufgym.utils.errors import unknown

VARIABLE = "BUFGYM_KERNELS"
"""Environment variable that chooses between the ways."""
C, CHECKED, PYTHON = "c", "checked", "python"


def way(asked: str) -> str:
    """The way that ``asked``, the value of the environment variable, names: C unless it says otherwise."""
    if asked not in ("", C, CHECKED, PYTHON):
        raise unknown("way", asked, (C, CHECKED, PYTHON), place=VARIABLE)
    return asked or C


WAY = way(os.environ.get(VARIABLE, ""))
JIT = WAY != PYTHON
"""False where every kernel runs as its Python source."""

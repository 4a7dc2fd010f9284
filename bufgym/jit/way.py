"""Which of three ways kernels take: our pipeline in Numba's compiler, plain Numba, or no compilation at all.

The pipeline compiles faster, and changes parts of Numba that its authors may change in every version. Plain Numba works
with any version, and gives the same results.
"""

import os
import re
import sys
from importlib.metadata import version

from bufgym.utils.errors import unknown

VARIABLE = "BUFGYM_COMPILER"
"""Environment variable that chooses between the ways to compile."""
PIPELINE, PLAIN = "pipeline", "plain"

FIRST, AFTER = (0, 63), (0, 69)
"""The first version of Numba that ``pipeline`` knows, and the first that it does not know any more."""


def _compiles() -> bool:
    # A program may have switched it off in Numba's settings, which then count and not the environment.
    if "numba" in sys.modules:
        return not sys.modules["numba"].config.DISABLE_JIT
    return os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")


def knows(numba: str) -> bool:
    """Whether the pipeline knows this version of Numba, such as "0.68.1"; a version without numbers is unknown."""
    numbers = re.match(r"(\d+)\.(\d+)", numba)
    return numbers is not None and FIRST <= (int(numbers[1]), int(numbers[2])) < AFTER


def compiler(asked: str, numba: str) -> str:
    """The way to compile that ``asked``, the value of the environment variable, names; else the one for this Numba."""
    if asked not in ("", PIPELINE, PLAIN):
        raise unknown("compiler", asked, (PIPELINE, PLAIN), place=VARIABLE)
    return asked or (PIPELINE if knows(numba) else PLAIN)


JIT = _compiles()
"""False where compilation is off and every kernel runs as its Python source."""

COMPILER = compiler(os.environ.get(VARIABLE, ""), version("numba")) if JIT else ""
"""``pipeline`` or ``plain``; empty where compilation is off."""

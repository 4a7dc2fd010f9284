"""Whether a live program decides in plain Python or in compiled code.

Kernels give the same decisions either way. In plain Python a decision of most rules takes about 1 ms, nothing has to be
compiled before the first message, and the program needs a quarter of the memory. Compiled, a decision takes 0.05 ms.
"""

import os
import sys
from typing import Annotated

from cyclopts import Parameter

Compiled = Annotated[
    bool, Parameter(help="Decide in compiled code: 0.05 ms in place of about 1 ms, after some seconds, once.")
]


def decide_in_python(*, unless: bool = False) -> None:
    """Let this program run without a compiler from now on, if it has not imported one yet."""
    if not unless and "bufgym.jit" not in sys.modules:
        os.environ["NUMBA_DISABLE_JIT"] = "1"

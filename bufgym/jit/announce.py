"""What goes on around compiling: a notice on stderr when it takes long; no garbage collection, no coloured errors."""

import contextlib
import gc
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

from numba.core import errors

PATIENCE_S = 1.0  # Compiling time of one kernel after which the notice appears, s
NOTICE = "bufgym: compiling, once (about 10 s; bufgym warmup does it beforehand)"

_COLOURLESS = SimpleNamespace(**dict.fromkeys(("code", "errmsg", "filename", "indicate", "highlight", "reset"), str))
"""A colour scheme of Numba's without colours."""

_is_silent = False


def say() -> None:
    """Write ``NOTICE``, once in a process."""
    if not _is_silent and sys.stderr is not None:
        sys.stderr.write(f"{NOTICE}\n")  # in one piece, as the process may end meanwhile
        sys.stderr.flush()
    compile_silently()


def compile_silently() -> None:
    """Make this process write no notice from now on."""
    global _is_silent
    _is_silent = True


@contextlib.contextmanager
def compiling() -> Iterator[None]:
    """Write the notice if the block, which compiles a kernel, takes long."""
    # Numba makes objects by the million and drops few: searching them for garbage is a tenth of the time.
    # It makes errors by the thousand and drops all: where colorama is installed, colouring them is another tenth.
    collects, numbas = gc.isenabled(), cast(Any, errors)
    scheme, numbas._termcolor_inst = numbas._termcolor_inst, _COLOURLESS
    gc.disable()
    notice = threading.Timer(PATIENCE_S, say)
    notice.daemon = True
    notice.start()
    try:
        yield
    finally:
        notice.cancel()
        numbas._termcolor_inst = scheme
        if collects:
            gc.enable()

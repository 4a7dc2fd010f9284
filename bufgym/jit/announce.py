"""A notice on stderr when compiling takes long."""

import contextlib
import sys
import threading
from collections.abc import Iterator

PATIENCE_S = 1.0  # Compiling time of one kernel after which the notice appears, s
NOTICE = "bufgym: compiling, once (about 10 s; bufgym warmup does it beforehand)"

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
def if_long() -> Iterator[None]:
    """Write the notice if the block, which compiles a kernel, takes long."""
    notice = threading.Timer(PATIENCE_S, say)
    notice.daemon = True
    notice.start()
    try:
        yield
    finally:
        notice.cancel()

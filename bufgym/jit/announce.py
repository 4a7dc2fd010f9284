"""A notice on stderr when compiling takes long."""

import sys

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

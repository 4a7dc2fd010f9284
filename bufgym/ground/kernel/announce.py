"""A notice on stderr when compiling takes long."""

import sys
import threading
from typing import Any, cast

from numba.core import event

PATIENCE_S = 1.0  # Compiling time of one kernel after which the notice appears, s
NOTICE = "bufgym: compiling, once (about 10 s; bufgym warmup does it beforehand)"


class _Announcer(event.Listener):
    """Writes ``NOTICE`` to stderr once, when a kernel takes more than ``PATIENCE_S`` to compile.

    Numba reports each kernel that it compiles, with those compiled on the way; it does not report kernels from the
    cache.
    """

    def __init__(self) -> None:
        self.done = False
        self._depth = 0
        self._timer: threading.Timer | None = None

    def on_start(self, compiling: Any) -> None:
        if not _is_ours(compiling):
            return
        self._depth += 1
        if self._depth == 1 and not self.done:
            self._timer = threading.Timer(PATIENCE_S, self.say)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, compiling: Any) -> None:
        if not _is_ours(compiling):
            return
        self._depth -= 1
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def say(self) -> None:
        if not self.done and sys.stderr is not None:
            print(NOTICE, file=sys.stderr, flush=True)
        self.done = True


def _is_ours(compiling: Any) -> bool:
    return str(compiling.data["dispatcher"].py_func.__module__).split(".")[0] == "bufgym"


_announcer = _Announcer()
cast(Any, event).register("numba:compile", _announcer)


def say() -> None:
    """Write ``NOTICE`` now, unless it was written before."""
    _announcer.say()


def compile_silently() -> None:
    """Make this process write no notice from now on."""
    _announcer.done = True

"""Processes that work for this one: they end with it, and one of them may compile in its place."""

import functools
import os
import subprocess
import sys
import threading
import time
from typing import Final

PATIENCE_S: Final = 1.0  # Time between a worker's checks that its parent process is alive
_CALL = "import sys; sys.path[:] = {path!r}; from {module} import {name}; {name}({arguments})"


@functools.cache
def end_with(parent: int) -> None:
    """End this process soon after ``parent``, the process number of its parent, has ended.

    A killed parent's workers would hold its pipes and files for ever. It may be gone when a worker calls this.
    """
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(PATIENCE_S)
    os._exit(1)


def compiling(module: str, name: str, *arguments: str) -> int:
    """Call the function ``name`` of ``module`` in another process, which compiles; return that process's exit code.

    The compiler would hold this process's lock for tens of seconds.
    """
    path = [place for place in sys.path if isinstance(place, str)]
    call = _CALL.format(path=path, module=module, name=name, arguments=", ".join(map(repr, arguments)))
    return subprocess.run([sys.executable, "-c", call], check=False).returncode

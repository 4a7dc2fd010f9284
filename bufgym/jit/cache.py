"""Storage of the pipeline's code: a file for each kernel, set of argument types, and state of all that it calls."""

import contextlib
import pickle
from pathlib import Path
from typing import Any, cast

from numba.core import compiler, serialize

from bufgym.jit.folder import CACHED_ONLY, FOLDER, NotCachedError, delete_old, readable_name, state
from bufgym.utils.files import replaced


class Code:
    """Machine code of one kernel on disk, a file for each set of argument types.

    A file is named by everything that its code depends on (see ``fingerprint``). So processes that compile side by side
    never write different code into one file, and code of an earlier source is never found. A damaged file is compiled
    anew. If no file can be written, nothing is cached.
    """

    def __init__(self, function: Any, role: str) -> None:
        self._function = function
        self._name = readable_name(function, role)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Code compiled for the types of ``signature``, or None if there is none."""
        try:
            cached = pickle.loads(self._file(signature, target.codegen()).read_bytes())
            return cast(Any, compiler).CompileResult._rebuild(target, *cached)
        except Exception:  # a file that is missing, or cut short, which ends in many kinds of error
            if CACHED_ONLY.get():
                raise NotCachedError from None
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Cache the code that was compiled for the types of ``signature``."""
        if result.lifted or result.library.has_dynamic_globals:  # it holds addresses of this process
            return
        file = self._file(signature, result.codegen)
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            # Whole or not at all: another process may read it at this moment.
            with replaced(file) as part:
                part.write_bytes(cast(Any, serialize).dumps(result._reduce()))
            delete_old(self._name)

    def _file(self, signature: Any, generator: Any) -> Path:
        return Path(FOLDER, f"{self._name}-{state(self._function, signature, generator.magic_tuple())}.nbc")

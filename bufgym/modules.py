"""What is named as text by ``module:function``: a policy, a V, a link generator, a scenario of one's own.

The module is imported, from the current folder too, and importing runs its code: names that come from files of
strangers (leaderboards, results, configurations of clients) never get here.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
import sys
from pathlib import Path
from typing import Any

from bufgym.errors import BufgymError, line_in

_NAMED = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
"""A setting, as in ``decimate:every=2``, has a "=" behind the colon."""

FILES: list[str] = []
"""Those of the modules imported here: an error that comes from one of them is the caller's own."""


def is_named(text: str) -> bool:
    """Whether the text reads ``module:function``."""
    return _NAMED.fullmatch(text) is not None


def find(text: str, folder: str | None = None) -> Any:
    """What ``module:function`` names; the module is looked for in ``folder`` (None: the current one) too.

    Raises:
        BufgymError: there is none.
    """
    module, _, name = text.partition(":")
    found = getattr(imported(text, folder or os.getcwd()), name, None)
    if found is None:
        raise BufgymError(f"{text}: the module {module} has no {name}")
    return found


def imported(text: str, folder: str, also: str = "") -> Any:
    """The module of ``module:function``; ``also``: what else the text could have been, for the message."""
    place = text.partition(":")[0]
    # The installed command, unlike python -m bufgym, does not look for modules in the current folder.
    if folder not in map(os.path.abspath, sys.path):
        sys.path.append(folder)
    try:
        module = importlib.import_module(place)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{place}.".startswith(f"{error.name}."):
            raise BufgymError(f"{text}: {place} imports {error.name}, which is not there") from None
        here = f"in {folder} or among those installed"
        what = f"neither {also} {place!r} nor a module of that name" if also else f"no module {place!r}"
        raise BufgymError(f"{text}: {what} {here}") from None
    except Exception as error:  # whatever the module does when it is run
        raise BufgymError(f"{text}: cannot be imported: {type(error).__name__}: {error}") from None
    if module.__file__ is not None and module.__file__ not in FILES:
        FILES.append(module.__file__)
    return module


def run_file(path: str, option: str) -> None:
    """Run the caller's Python file, which registers what is his own; ``option``: where it was named."""
    if not Path(path).is_file():
        raise BufgymError(f"{path}: no such file ({option})")
    spec = importlib.util.spec_from_file_location(
        f"bufgym_{option.strip('-').replace('-', '_')}_{Path(path).stem}", path
    )
    if spec is None or spec.loader is None:
        raise BufgymError(f"{path}: must be a Python file, named .py")
    module = importlib.util.module_from_spec(spec)
    # Compiled functions are pickled by their module's name.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise BufgymError(f"{path}, line {error.lineno}: {error.msg}") from None


def line_of(error: Exception, *files: str | None) -> str | None:
    """Where in the caller's code the error came from, these files or a module imported here; None for nowhere there."""
    places = (line_in(error, file) for file in [*filter(None, files), *FILES])
    return next(filter(None, places), None)


def first_line(documented: Any) -> str:
    """The first line of its docstring; empty if there is none."""
    return (inspect.getdoc(documented) or "").split("\n")[0]


def needs(function: Any) -> int:
    """Arguments without a default; -1 where they cannot be told."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return -1
    kinds = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    return sum(parameter.kind in kinds and parameter.default is parameter.empty for parameter in parameters)

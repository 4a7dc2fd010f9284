"""Your own policy, V, link generator or scenario, named in text as ``module:function``.

Importing the module runs its code, and modules in the current folder count too. Names from untrusted files, such as
leaderboards, results and configurations of clients, therefore never get here.
"""

import importlib.util
import inspect
import os
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bufgym.utils.errors import BufgymError

_NAMED = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
"""A setting such as ``decimate:every=2`` does not match, as it has "=" after the colon."""

FILES: list[str] = []
"""Files that were run or imported here. An error that comes from one of them is the caller's own."""


def is_named(text: str) -> bool:
    """Whether the text has the form ``module:function``."""
    return _NAMED.fullmatch(text) is not None


def find(text: str, folder: str | None = None, also: str = "") -> Any:
    """The object named by ``module:function``; ``folder`` (by default the current one) is searched for the module too.

    Raises:
        BufgymError: no such module or function; the message mentions ``also``, another reading of the text.
    """
    module, _, name = text.partition(":")
    found = getattr(imported(text, folder or os.getcwd(), also), name, None)
    if found is None:
        raise BufgymError(f"{text}: the module {module} has no {name}")
    return found


def made(text: str, folder: str, also: str = "") -> Any:
    """The object named by ``module:function``, or what it makes if it is a function without arguments; see ``find``."""
    found = find(text, folder, also)
    return found() if callable(found) and needs(found) == 0 else found


def imported(text: str, folder: str, also: str = "") -> Any:
    """Import the module of ``module:function``; the error message mentions ``also``, another reading of the text."""
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
    except Exception as error:  # any error that the module's own code raises
        raise BufgymError(f"{text}: cannot be imported: {type(error).__name__}: {error}") from None
    if module.__file__ is not None and module.__file__ not in FILES:
        FILES.append(module.__file__)
    return module


def run_file(path: str, option: str) -> None:
    """Run the caller's Python file, which registers their own objects; ``option`` is the option that named the file."""
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
    if path not in FILES:
        FILES.append(path)
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise BufgymError(f"{path}, line {error.lineno}: {error.msg}") from None


def line_of(error: Exception) -> str | None:
    """The innermost line of one of ``FILES`` that raised the error ("mine.py, line 3"), or None."""
    places = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    for file in FILES:
        if lines := [line for path, line in places if os.path.abspath(path) == os.path.abspath(file)]:
            return f"{file}, line {lines[-1]}"
    return None


def first_line(documented: Any) -> str:
    """The first line of an object's docstring, or empty text."""
    return (inspect.getdoc(documented) or "").split("\n")[0]


def needs(function: Any) -> int:
    """Number of arguments without a default; -1 if unknown."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return -1
    kinds = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    return sum(parameter.kind in kinds and parameter.default is parameter.empty for parameter in parameters)


def takes(function: Any, count: int) -> bool:
    """Whether the function can be called with so many arguments; True if its signature is unknown."""
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:
        return True
    return True


def on_demand(package: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """Make a subpackage's ``__getattr__`` (PEP 562), which imports a public name when it is first asked for.

    ``places`` maps each name to the module in it that defines it; a module's own name maps to itself.
    """

    def get(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(f"{package}.{places[name]}")
        return module if places[name] == name else getattr(module, name)

    return get

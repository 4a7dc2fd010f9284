"""Errors about files, in the form that all readers and writers share."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike

from bufgym.ground.errors import TraceError, TraceWarning, where

StrPath = str | PathLike[str]


def fault(
    path: StrPath, rule: str, *, line: int | None = None, value: object | None = None, field: str | None = None
) -> TraceError:
    """Make the error about a file; arguments are as in `bufgym.ground.errors.where`."""
    return TraceError(where(path, line, value, rule, field=field))


def warn(path: StrPath, doubt: str, *, line: int | None = None) -> None:
    """Warn of what a file says that may be wrong, though it breaks no rule."""
    warnings.warn(TraceWarning(where(path, line, None, doubt)), stacklevel=2)


@contextmanager
def os_errors(path: StrPath, action: str) -> Iterator[None]:
    """Turn an OSError into a TraceError: the file "cannot be read" (or whatever the action is), and why."""
    try:
        yield
    except OSError as error:
        raise fault(path, f"cannot be {action}: {error.strerror or error}") from error

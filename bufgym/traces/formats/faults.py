"""Errors about files, in the form that all readers and writers share."""

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike

from bufgym.ground.errors import TraceError, where

StrPath = str | PathLike[str]


def fault(
    path: StrPath, rule: str, *, line: int | None = None, value: object | None = None, field: str | None = None
) -> TraceError:
    """Make the error about a file; arguments are as in `bufgym.ground.errors.where`."""
    return TraceError(where(path, line, value, rule, field=field))


@contextmanager
def os_errors(path: StrPath, action: str) -> Iterator[None]:
    """Turn an OSError into a TraceError: the file "cannot be read" (or whatever the action is), and why."""
    try:
        yield
    except OSError as error:
        raise fault(path, f"cannot be {action}: {error.strerror or error}") from error

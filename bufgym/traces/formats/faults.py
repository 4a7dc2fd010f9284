"""Errors about files, in the form that all readers and writers share."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from os import PathLike
from typing import Final

import numpy as np
import numpy.typing as npt

from bufgym.utils.errors import TraceError, TraceWarning, where

StrPath = str | PathLike[str]

_FEW: Final = 0.05  # A share of samples left out that is no more than a clock's coarse digits now and then
_MANY: Final = 10  # Samples of one time that are more than a burst: sound recordings have up to seven


def fault(
    path: StrPath, rule: str, *, line: int | None = None, value: object | None = None, field: str | None = None
) -> TraceError:
    """Make the error about a file; arguments are as in `bufgym.utils.errors.where`."""
    return TraceError(where(path, line, value, rule, field=field))


def warn(path: StrPath, doubt: str, *, line: int | None = None) -> None:
    """Warn of what a file says that may be wrong, though it breaks no rule."""
    warning = TraceWarning(where(path, line, None, doubt))
    for doubts in _heard.get():
        doubts.append(str(warning))
    warnings.warn(warning, stacklevel=2)


_heard: ContextVar[tuple[list[str], ...]] = ContextVar("_heard", default=())


@contextmanager
def heard() -> Iterator[list[str]]:
    """Collect what ``warn`` says meanwhile, so that it stays with the recording."""
    doubts: list[str] = []
    token = _heard.set((*_heard.get(), doubts))
    try:
        yield doubts
    finally:
        _heard.reset(token)


@contextmanager
def os_errors(path: StrPath, action: str) -> Iterator[None]:
    """Turn an OSError into a TraceError: the file "cannot be read" (or whatever the action is), and why."""
    try:
        yield
    except OSError as error:
        raise fault(path, f"cannot be {action}: {error.strerror or error}") from error


class LeftOut:
    """Counts samples that are left out because a later one has the same time."""

    def __init__(self) -> None:
        self.total = 0
        """Samples so far."""
        self.first = 0
        """Line, or place, of the first that shares its time with a later one; 0 while there is none."""
        self._count = self._most = 0
        self._last: int | None = None
        self._of_last = self._place = 0  # samples of the last time; place of the last sample

    def add(self, times: npt.NDArray[np.int64], places: npt.NDArray[np.int64]) -> None:
        """Add samples in order of time, int64[m], m >= 1, with their lines or places."""
        is_last = np.append(times[1:] != times[:-1], True)
        alike = np.diff(np.flatnonzero(is_last), prepend=-1)  # samples of each time
        again = self._last is not None and self._last == times[0]
        if not self.first and (again or not is_last.all()):
            self.first = self._place if again else int(places[np.argmin(is_last)])
        alike[0] += self._of_last * again
        self.total += len(times)
        self._count += int(np.count_nonzero(~is_last)) + again
        self._most = max(self._most, int(alike.max()))
        self._last, self._of_last, self._place = int(times[-1]), int(alike[-1]), int(places[-1])

    def said(self, path: StrPath, what: str, place: str = "line", effect: str = "", verb: str = "left out ") -> str:
        """Warn of them if they are many, or several of one time; otherwise return a note for the source's text.

        ``verb`` says what was done with them: nothing, if it is empty.
        """
        if not self._count:
            return ""
        shared = "that share a time" if verb else "share a time"
        doubt = f"{verb}{self._count:,} of {self.total:,} {what} {shared} with a later one"
        if (self._count == 1 or self._count <= _FEW * self.total) and self._most < _MANY:
            return f", {doubt}"
        warn(path, f"{doubt}, the first in {place} {self.first}, at most {self._most} of one time{effect}")
        return ""

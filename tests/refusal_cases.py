"""Wrong uses: one of them, and tables of them as tests."""

from collections.abc import Callable
from typing import Any

import pytest

from bufgym.utils.errors import BufgymError


def refuse(says: str, use: Any, *given: Any, kind: type[Exception] = BufgymError, **named: Any) -> None:
    """``use(*given, **named)`` must raise an error of this kind, in one line that matches the pattern ``says``."""
    with pytest.raises(kind, match=says) as caught:
        use(*given, **named)
    assert "\n" not in str(caught.value)
    del caught  # and with it the frames in which the error was raised, which hold sockets and files


def refused(*cases: tuple[Callable[[], object], str] | tuple[Callable[[], object], str, type[Exception]]) -> Any:
    """A test that each use raises an error, a BufgymError unless another is named, whose text matches the pattern."""

    @pytest.mark.parametrize(("use", "says", "kind"), [(*case, BufgymError)[:3] for case in cases])
    def test(use: Callable[[], object], says: str, kind: type[Exception]) -> None:
        refuse(says, use, kind=kind)

    return test

"""Tables of wrong uses as tests."""

from collections.abc import Callable
from typing import Any

import pytest

from bufgym.ground.errors import BufgymError


def refused(*cases: tuple[Callable[[], object], str] | tuple[Callable[[], object], str, type[Exception]]) -> Any:
    """A test that each use raises an error, a BufgymError unless another is named, in one line of this pattern."""

    @pytest.mark.parametrize(("use", "says", "kind"), [(*case, BufgymError)[:3] for case in cases])
    def test(use: Callable[[], object], says: str, kind: type[Exception]) -> None:
        with pytest.raises(kind, match=says) as caught:
            use()
        assert "\n" not in str(caught.value)

    return test

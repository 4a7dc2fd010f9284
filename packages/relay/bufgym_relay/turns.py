"""A watch over the turns of the event loop: whoever takes a long one keeps all others waiting, and is logged."""

import time
import types
from collections.abc import Callable, Coroutine, Generator
from typing import Any, Final

LONG_S: Final = 0.02  # Turn beyond which who took it is logged
_MOST: Final = 1_000  # who are told apart
clock: Callable[[], float] = time.perf_counter


class Turns:
    """Longest turns since they were last told, by who took them."""

    def __init__(self) -> None:
        self._long: dict[str, list[float]] = {}

    def note(self, who: str, began_s: float) -> None:
        """Note a turn that began then and ends now."""
        took_s = clock() - began_s
        if took_s > LONG_S and (who in self._long or len(self._long) < _MOST):
            self._long.setdefault(who, []).append(took_s)

    def take(self) -> dict[str, list[float]]:
        """Give who took long turns, and how long each was, s; begin anew."""
        long, self._long = self._long, {}
        return long

    async def of(self, who: str, begin: Callable[[], Coroutine[Any, Any, Any]]) -> Any:
        """Do the work that ``begin`` returns, unless this is cancelled before; note each of its turns."""
        return await self._turn_by_turn(who, begin())

    @types.coroutine  # Since Python 3.12 no task takes it itself
    def _turn_by_turn(self, who: str, work: Coroutine[Any, Any, Any]) -> Generator[Any, Any, Any]:
        resume: Callable[[Any], Any] = work.send
        value: Any = None
        while True:
            began_s = clock()
            try:
                step = resume(value)
            except StopIteration as end:
                return end.value
            finally:
                self.note(who, began_s)
            try:
                value = yield step
                resume = work.send
            except BaseException as error:  # for the work to handle
                value, resume = error, work.throw

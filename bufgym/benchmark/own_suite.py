"""``bufgym.suite``: a suite of one's own."""

from collections.abc import Mapping, Sequence
from typing import Any

from bufgym import scenario as registered
from bufgym.benchmark import tasks
from bufgym.scenario import suites
from bufgym.scenario.suites.own import own_suite
from bufgym.utils.errors import BufgymError
from bufgym.utils.modules import find, is_named


def suite_named(on: Any) -> str:
    """The name of the suite that ``on`` is or names; empty for a scenario."""
    if isinstance(on, suites.Suite):
        return suites.add(on).name if on.own else on.name
    if isinstance(on, str) and on in suites.SUITES:
        return on
    is_own = isinstance(on, str) and is_named(on) and isinstance(find(on), suites.Suite)
    return suites.named(on) if is_own else ""


def suite(
    name: str, scenarios: Any, *, capacity: int | Sequence[int] = 8, seeds: int = 10, about: str = ""
) -> suites.Suite:
    """A suite of your own, scenarios frozen by seeds: for ``compare``, ``bufgym bench --suite module:NAME`` and boards.

    Its splits train, validation and test have the same scenarios and other seeds, so no episode is in two of them. The
    suite is known by its name from then on, as in ``gym.make("bufgym/Suite-v1", suite="lab-v1", split="train")``.

        lab = bufgym.suite("lab-v1", {"slow": "lte:rate_hz=10", "fast": "lte:rate_hz=30"}, capacity=[8, 16], seeds=20)
        print(bufgym.compare(["afr", "target-gap"], lab))

    Args:
        name: its name with a version, such as "lab-v1": a changed suite gets the next one.
        scenarios: a scenario or its name, or several of one kind by label.
        capacity: L, messages, or several.
        seeds: episodes on each trace, 1 to 300.
        about: a line about it.

    Raises:
        BufgymError: an argument is out of its range, or scenarios are of different kinds.
    """
    many = scenarios if isinstance(scenarios, Mapping) else {name: scenarios}
    kinds = {tasks.task_for(registered.get(spec)).kind for spec in many.values()}
    if len(kinds) > 1:
        raise BufgymError(f"suite {name}: scenarios of {' and '.join(sorted(kinds))}: must be of one kind")
    kind = kinds.pop() if kinds else "queue"
    return suites.add(own_suite(name, scenarios, capacity=capacity, seeds=seeds, about=about, kind=kind))

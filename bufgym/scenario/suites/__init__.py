"""Benchmark suites: frozen, versioned sets of episodes on which results are quoted.

A suite has scenarios, capacities, and episodes in three splits: ``train`` to learn from, ``validation`` to choose
parameters by, ``test`` to report. Splits share no bandwidth trace and no motion recording; with one interruption they
share no length T. So knowing a trace by heart gains nothing in another split. A suite never changes; an improved one
gets the next version.

``Suite.kind`` names the task of the scenarios: one queue, the same under stress, the topics of one client, or a fleet
of robots. Messages of one queue have equal sizes, so that the clairvoyant's bound is exact, but for ``cameras``.
"""

from dataclasses import replace

from bufgym.scenario.suites import cameras, recorded, shared_uplinks, stress, synthetic
from bufgym.scenario.suites.suite import CAPACITIES, SPLITS, Setting, Suite
from bufgym.scenario.suites.synthetic import RATE_HZ, motion_value, time_value
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError, unknown

__all__ = ["CAPACITIES", "RATE_HZ", "SPLITS", "SUITES", "Setting", "Suite", "get", "motion_value", "time_value"]

SUITES = {
    suite.name: suite
    for suite in (*synthetic.SUITES, *cameras.SUITES, *stress.SUITES, *recorded.SUITES, *shared_uplinks.SUITES)
}
"""Every suite by name."""


_BUILT_IN = frozenset(SUITES)


def get(name: str) -> Suite:
    """The suite of that name."""
    if name not in SUITES:
        raise unknown("suite", name, SUITES, also=", and module:NAME for one's own")
    return SUITES[name]


def add(suite: Suite) -> Suite:
    """Make one's own suite known by its name; another of that name takes its place, but not a built-in's."""
    if suite.name in _BUILT_IN:
        raise BufgymError(f"suite {suite.name!r}: a built-in suite has this name")
    SUITES[suite.name] = suite
    return suite


def named(text: str) -> str:
    """The name of the suite that the user named: a known one, or ``module:NAME``, whose module is imported."""
    if text in SUITES or not modules.is_named(text):
        return get(text).name
    found = modules.find(text)
    if not isinstance(found, Suite):
        raise BufgymError(f"{text}: must be a suite, as bufgym.suite(...) makes it, not {type(found).__name__}")
    return add(replace(found, source=text)).name

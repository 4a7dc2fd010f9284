"""Episodes by seed, the same in a row of a benchmark and in the reset of an environment."""

from dataclasses import replace
from typing import Any

from bufgym.model.checks import whole
from bufgym.scenario.episode import Streams
from bufgym.utils.errors import BufgymError, unknown

SEEDS_PER_TRACE = 1000
"""Episode s of trace k in a suite has the seed 1000 k + s, so no two traces of a scenario share a draw."""


def draw(scenario: Any, seed: int) -> Any:
    """Draw the episode of this seed, with the uniform draws of randomised policies."""
    streams = Streams.seeded(seed)
    return scenario.draw(streams).with_uniforms(streams.policy)


def by_trace(scenario: Any) -> list[tuple[str, Any]]:
    """Split the scenario into one part per trace, as (label, part); equal names get a number."""
    uplink = getattr(scenario, "uplink", None)
    if uplink is not None:  # a fleet's uplink, which its robots share
        return [(label, replace(scenario, uplink=part)) for label, part in by_trace(uplink)]
    traces = getattr(scenario, "traces", None)
    if traces is None:
        return [(type(scenario).__name__.lower(), scenario)]
    labels: list[str] = []
    for trace in traces:
        same = sum(other.name == trace.name for other in traces[: len(labels)])
        labels.append(f"{trace.name}#{same + 1}" if same else trace.name)
    return [(label, replace(scenario, traces=(trace,))) for label, trace in zip(labels, traces, strict=True)]


def numbered(family: Any, seed: Any = None, trace: str | int | None = None, scenario: str | None = None) -> Any:
    """The episode of the benchmark row with this seed, trace and scenario.

    Args:
        family: a ``Scenario``; a suite's has ``members``.
        seed: the row's.
        trace: the row's, or its number from 0 on. Leave it out if there is only one, or in a suite: there the seed
            tells it (``SEEDS_PER_TRACE``).
        scenario: the row's; only in a suite.

    Raises:
        BufgymError: there is no such episode.
    """
    members = getattr(family, "members", None)
    if members is None:
        if scenario is not None:
            raise BufgymError(f"scenario = {scenario!r}: only the episodes of a suite have one")
        part = _part(family, trace)
        return draw(part, _seed(seed))
    if scenario is None:
        labels = dict.fromkeys(label for member in members.values() for label, _ in by_trace(member))
        if isinstance(trace, str) and trace not in labels:
            raise unknown("trace", trace, labels)
        raise BufgymError(f"scenario: missing; a suite's row has one besides its seed: one of {', '.join(members)}")
    if scenario not in members:
        raise BufgymError(f"scenario = {scenario!r}: must be one of {', '.join(members)}")
    member, seed = members[scenario], _seed(seed)
    return draw(_part(member, seed // SEEDS_PER_TRACE if trace is None else trace), seed).valued(member.value)


def _seed(given: Any) -> int:
    if given is None:
        rule = "it names a row, as in options={'trace': 0, 'seed': 4}; that of reset(seed=4) is for what is drawn"
        raise BufgymError(f"options: no seed: {rule}")
    return whole("seed", given)


def _part(scenario: Any, trace: str | int | None) -> Any:
    """The scenario on that trace alone."""
    parts = by_trace(scenario)
    labels = [label for label, _ in parts]
    if trace is None and len(parts) == 1:
        trace = 0
    if isinstance(trace, str) and trace in labels:
        trace = labels.index(trace)
    if isinstance(trace, str):
        raise unknown("trace", trace, labels, also=f", or their numbers 0..{len(parts) - 1}")
    if not isinstance(trace, int) or not 0 <= trace < len(parts):
        raise BufgymError(f"trace = {trace!r}: must be 0..{len(parts) - 1} or one of {', '.join(labels)}")
    return parts[trace][1]
